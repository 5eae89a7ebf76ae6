"""Python and YAML of documents, checked without running them: imports, names, and settings as what
they are."""

import ast
import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import yaml
from project import ROOT

from lidar_synth.bake import BakeJob
from lidar_synth.errors import LibraryError
from lidar_synth.geometry.layout.files import load_layout
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.train import DistillConfig, TrainConfig, load_config
from lidar_synth.mixing.settings import OPTIONS


def check_python(code: str) -> None:
    """Refuse code that imports what this package lacks, or names what its adapters do not register.

    Raises:
        SyntaxError: on code that does not compile.
        AssertionError: on a module, a name or a type of ours that does not exist.
    """
    tree = ast.parse(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
            "lidar_synth"
        ):
            known = names_of(str(node.module))
            assert all(alias.name in known for alias in node.names), (
                f"{node.module} has not all of {ast.unparse(node)}"
            )
    for module in re.findall(r"[\"'](lidar_synth\.[\w.]+)[\"']", code):
        assert find_spec(module), f"there is no module {module}"
    adapters = "\n".join(
        path.read_text() for path in (ROOT / "integrations").glob("*.py")
    )
    for kind in re.findall(r"type=[\"']((?:Synth|Mixed)\w+)[\"']", code):
        assert f'"{kind}"' in adapters or f"class {kind}" in adapters, (
            f"no adapter has {kind!r}"
        )


def names_of(module: str) -> set[str]:
    """What can be imported from a module; from its source where the trainer that it imports is not
    installed."""
    try:
        found = import_module(module)
        return set(dir(found)) | set(getattr(found, "__all__", ()))
    except (ImportError, LibraryError):
        spec = find_spec(module)
        assert spec and spec.origin, f"there is no module {module}"
        nodes = ast.parse(Path(spec.origin).read_text()).body
        return {
            node.name
            for node in nodes
            if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }


def check_yaml(code: str, path: Path) -> None:
    """Read settings as what they are: those of a mixture, a sensor, a layout, a recipe, or some
    keys of these.

    Args:
        code: the settings.
        path: where to write them; recipes find their own sensors beside it.
    """
    values = yaml.safe_load(code)
    assert isinstance(values, dict), "settings are keys and values"
    path.write_text(code)
    if all(
        isinstance(entry, dict) and "range_max" in entry for entry in values.values()
    ):
        assert load_sensor(path).name in values
    elif "objects" in values:
        assert load_layout(path).boxes.names
    elif set(values) & {"base", "network"}:
        load_config(DistillConfig if "teacher" in values else TrainConfig, path)
    else:
        keys = {
            *OPTIONS,
            *TrainConfig.model_fields,
            *DistillConfig.model_fields,
            *BakeJob.model_fields,
        }
        assert set(values) <= keys, (
            f"keys {sorted(set(values) - keys)} are known nowhere"
        )
