"""Misspelt names: the error names the nearest ones."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.errors import suggest
from lidar_synth.formats.description import Description

CALLS = {
    "train twon": "'town'",
    "train town_tiny recipe.itterations=3": "'iterations'",
    "distill town_studnt": "'town_student'",
    "sample OUT --model twon": "'town'",
    "sample OUT --to kiti": "'kitti'",
    "bake OUT --engine locl": "'local'",
    "town OUT --layout kiti360": "'kitti360'",
    "town OUT --sensor hdl64e_kiti": "'hdl64e_kitti'",
    "town OUT --skin pandar46": "'pandar64'",
    "convert OUT OUT --to npz --layout semantic_kity": "'semantic_kitti'",
    "evaluate OUT OUT --protocol r2flo": "'r2flow'",
}


@pytest.mark.parametrize("call", CALLS)
def test_a_misspelt_name_is_answered_with_the_nearest(
    call: str, tmp_path: Path
) -> None:
    given = call.replace("OUT", str(tmp_path / "out")).split()
    result = CliRunner().invoke(app, given)
    said = (
        result.output
        if result.exception is None
        else f"{result.output}{result.exception}"
    )
    assert (
        result.exit_code != 0
        and "Did you mean" in said
        and CALLS[call] in said.split("Did you mean")[1]
    )


def test_a_name_like_none_has_no_suggestion() -> None:
    assert suggest("velodyne", ["kitti", "pcd"]) == ""


def test_the_sensor_of_a_folder_is_a_preset(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"sensor 'os1_12' is no preset.*Did you mean 'os1_128'"
    ):
        Description.from_dict(
            {"format": "lidar-synth-scans/1", "sensor": "os1_12", "origins": []}
        )
