"""What the test of the documents refuses: blocks, marks, commands and settings that are wrong."""

from pathlib import Path

import pytest
from commands import WrongCommand, check
from documents import Block, blocks_of, commands_of, reduced, spans_of
from snippets import check_python, check_yaml
from test_docs_blocks import Reader, named_in, read

PAGE = """# A page

<!-- setup: mkdir -p data -->
Run `lidar-synth doctor` and
`lidar-synth recipes`, or `town`.

<!-- not run: needs a GPU -->
```python
Bank("bank")
```

1. Then

    ```sh title="run.sh"
    lidar-synth sample out \\
        --count 4   # scans
    ```

<!-- slow: --count 2 for --count 9 -->
```console
$ lidar-synth sample out --count 9
9 scans written
```
"""

WRONG_PAGES = {
    "an unknown language": ("```rust\nfn main() {}\n```\n", "'rust'"),
    "no language": ("```\nlidar-synth doctor\n```\n", "no language"),
    "an unknown reason": ("<!-- not run: too lazy -->\n```sh\nls\n```\n", "too lazy"),
    "a mark before text": ("<!-- not run: needs a GPU -->\nText\n", "before no block"),
}

WRONG_COMMANDS = {
    "lidar-synth grow OUT": "grow",
    "lidar-synth town OUT --scan 4": "--scan",
    "lidar-synth town OUT --layout kittti": "kittti",
    "lidar-synth town": "OUT",
    "lidar-synth train town_huge": "town_huge",
    "lidar-synth train town_tiny recipe.batches=4": "batches",
    "lidar-synth train town --until weaker": "weaker",
    "lidar-synth bake bank --engine spark": "spark",
    "lidar-synth bake bank --count 0": "count",
    "lidar-synth convert IN OUT --to laz": "laz",
    "lidar-synth town OUT && lidar-synth view OUT --quickly": "--quickly",
    "LIDAR_SYNTH_MIX=mix.yaml python -m lidar_synth.integrations.darknet train.py": "darknet",
    "python tools/demo.py out --scanz 3": "demo.py",
    "python tools/no_such.py": "no_such.py",
    "torchrun --nproc-per-machine 8 -m lidar_synth bake bank": "torchrun",
    "torchrun --nproc-per-node 8 -m lidar_synth bake bank --counts 3": "--counts",
    "make coffee": "coffee",
    "make demo SCAN=3": "SCAN",
    "pip install './lidar_synth[trains]'": "trains",
    "bash tools/no_such.sh": "no_such.sh",
    "lidarsynth doctor": "lidarsynth",
}

RIGHT_COMMANDS = (
    "lidar-synth town OUT --scans 4 --layout kitti",
    "lidar-synth train town_tiny recipe.batch=4 --resume",
    'lidar-synth curate bank --drop "confidence < 0.6" --out good',
    "LIDAR_SYNTH_MIX=mix.yaml python -m lidar_synth.integrations.openpcdet train.py --cfg_file "
    "any.yaml",
    "python tools/demo.py out --scans 3",
    "torchrun --nproc-per-node 8 -m lidar_synth bake bank --count 10 --engine torchrun",
    "make demo SCANS=6",
    "pip install -e '.[dev,open3d]'",
    "bash tools/install_mmdet3d.sh .venv",
    "cd OpenPCDet/tools && ls",
)

WRONG_PYTHON = {
    "a missing name": "from lidar_synth import MixedScanz",
    "a missing module": "from lidar_synth.mixer import Generated",
    "a missing name of an adapter": "from lidar_synth.integrations.pointcept import Nothing",
    "a missing module in a configuration": "custom_imports = dict("
    'imports=["lidar_synth.integrations.darknet"])',
    "a type that nobody registers": 'hooks = [dict(type="SynthEpochs")]',
}

WRONG_YAML = {
    "an unknown key": "synthetic: bank\nratios: 0.25\n",
    "a sensor of no beams": "mine: {rows: 0, fov_up: 15, fov_down: -25, columns: 64, "
    "range_min: 1, range_max: 120}\n",
    "a recipe on no base": "base: town_huge\n",
    "a list": "- 1\n",
}


def test_a_page_is_read_in_order() -> None:
    blocks = blocks_of(PAGE)
    assert [block.kind for block in blocks] == ["shell", "python", "shell", "shell"]
    assert [block.line for block in blocks] == [3, 9, 15, 21]
    assert [block.not_run for block in blocks] == [None, "needs a GPU", None, None]
    assert blocks[2].file == "run.sh"
    assert commands_of(blocks[2].code) == ["lidar-synth sample out --count 4"]
    assert commands_of(blocks[3].code) == ["lidar-synth sample out --count 9"]
    assert commands_of(reduced(blocks[3])) == ["lidar-synth sample out --count 2"]
    assert spans_of(PAGE) == [(4, "lidar-synth doctor"), (5, "lidar-synth recipes")]


@pytest.mark.parametrize(("text", "named"), WRONG_PAGES.values(), ids=list(WRONG_PAGES))
def test_a_wrong_mark_is_noticed(text: str, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        blocks_of(text)


@pytest.mark.parametrize("slow", ["--count 2", "--count 2 for --count 8"])
def test_a_reduction_that_fits_nothing_is_noticed(slow: str) -> None:
    with pytest.raises(ValueError, match="expected NEW for OLD"):
        reduced(Block("shell", "lidar-synth sample out --count 9", 1, slow=slow))


@pytest.mark.parametrize(("command", "named"), WRONG_COMMANDS.items())
def test_a_wrong_command_is_noticed(command: str, named: str, tmp_path: Path) -> None:
    with pytest.raises(WrongCommand, match=named):
        check(command, tmp_path)


@pytest.mark.parametrize("command", RIGHT_COMMANDS)
def test_a_right_command_is_none(command: str) -> None:
    check(command)


@pytest.mark.parametrize("code", WRONG_PYTHON.values(), ids=list(WRONG_PYTHON))
def test_python_that_names_what_does_not_exist_is_noticed(code: str) -> None:
    with pytest.raises(AssertionError):
        check_python(code)


@pytest.mark.parametrize("code", WRONG_YAML.values(), ids=list(WRONG_YAML))
def test_wrong_settings_are_noticed(code: str, tmp_path: Path) -> None:
    with pytest.raises((AssertionError, ValueError)):
        check_yaml(code, tmp_path / "settings.yaml")


def test_the_blocks_of_a_page_share_a_folder_and_a_namespace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (
        "```python\nimport os\nnumber = 3\nassert os.listdir() == []\n```\n"
        '```yaml title="mix.yaml"\nratio: 0.5\n```\n'
        "```sh\nexport WORD=here\ncat mix.yaml > copy.yaml\n```\n"
        '```python\nassert number == 3 and os.environ["WORD"] == "here" '
        'and "copy.yaml" in os.listdir()\n```\n'
    )
    read(Path("page.md"), blocks_of(text), Reader(tmp_path, monkeypatch))


@pytest.mark.parametrize(
    "code",
    ["python\n\n1 / 0", "sh\nls\nlidar-synth info no_bank", "sh\nls\ncat no_file"],
)
def test_a_block_that_fails_is_named(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(AssertionError, match=r"page\.md, line 2"):
        read(
            Path("page.md"),
            blocks_of(f"```{code}\n```\n"),
            Reader(tmp_path, monkeypatch),
        )


def test_a_page_finds_the_town_unless_it_makes_it() -> None:
    assert named_in(
        [Block("python", 'open_scans("demo_out/town"), Bank("demo_out/bank")', 1)]
    ) == [
        "demo_out/bank",
        "demo_out/town",
    ]
    assert (
        named_in(
            [
                Block(
                    "shell",
                    "lidar-synth town KITTI --scans 3\nlidar-synth view KITTI",
                    1,
                )
            ]
        )
        == []
    )
