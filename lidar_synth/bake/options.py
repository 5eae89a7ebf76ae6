"""The settings of a bake and of ``sample``. The options of both commands are generated from the
fields of ``BakeJob`` and ``Drawing``.

This module imports no heavy library, so that the command line starts at once.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Count = Annotated[int, Field(ge=1)]


def default_shard_size(count: int) -> int:
    """Scans per file of a bank of ``count`` scans."""
    return min(1024, max(64, count // 8))


class Drawing(BaseModel):
    """How a model generates scans: the options that ``sample`` and ``bake`` share; unknown keys
    are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: str = Field(
        "town", description="name of a shipped model, or a .safetensors checkpoint"
    )
    count: Count = Field(16, description="number of scans")
    seed: int = Field(
        0,
        ge=0,
        lt=2**64,
        description="scan i is a function of the model, the seed and i",
    )
    steps: Count | None = Field(None, description="number of steps [the model's own]")
    solver: str = Field("euler", description="ODE solver: euler | heun")
    condition: str | None = Field(
        None,
        description=(
            "dataset with the labels, images or boxes that a conditional model needs, or a "
            "layout.yaml"
        ),
    )
    condition_layout: str | None = Field(
        None, description="layout of that dataset [detected]"
    )
    condition_split: str | None = Field(
        None, description="split of that dataset, for instance r2flow/train"
    )
    objects: Literal["town", "drawn"] | None = Field(
        None,
        description=(
            "what stands in the boxes of layouts: town, objects that are cast there | "
            "drawn, by the model [town]"
        ),
    )
    guidance: float = Field(
        1.0,
        ge=0,
        le=100,
        description="scale of classifier-free guidance; 1 = no guidance",
    )
    batch: Count | None = Field(
        None, description="scans per batch [1 on a CPU, 16 on a GPU]"
    )
    columns: Count | None = Field(
        None,
        description="columns of the scans, for models that know several [the most]",
    )
    dtype: str = Field(
        "float32",
        description="data type of the network's computation: float32 | bfloat16",
    )
    device: str = Field("cpu", description="device of the network: cpu | cuda")


class BakeJob(Drawing):
    """Settings of a bake; unknown keys are refused. ``BakeJob.model_fields`` describes each of
    them.

    Example:
        >>> job = BakeJob(count=20_000, seed=1)
        >>> BakeJob.model_fields["first"].description
        'index of the first scan'
    """

    count: Count = Field(1000, description="number of scans")
    first: int = Field(0, ge=0, lt=2**62, description="index of the first scan")
    shard_size: Count | None = Field(
        None,
        description=(
            "scans per file, which an interrupted bake keeps; a worker needs the "
            "memory of two files [an eighth of all, 64 to 1024]"
        ),
    )
    fields: tuple[str, ...] | None = Field(
        None,
        description=(
            "what to store beside the range: reflectance,label,confidence,instance,boxes "
            "[all that the model generates]"
        ),
    )
    device: Literal["cpu", "cuda"] = Field(
        "cpu", description="device of the network: cpu | cuda"
    )
    threads: int = Field(
        1,
        ge=1,
        le=1024,
        description="CPU threads of each worker; with 1, every engine writes the same bytes",
    )
    compression: Literal["gzip", "blosc2"] = Field(
        "gzip", description="compression of the shards: gzip | blosc2"
    )
    layout: Literal["plain", "paged"] = Field(
        "plain",
        description="layout of the HDF5 files: plain | paged (for HDF5 over a network; stores "
        "times, so that bytes differ from run to run)",
    )
