"""Feature extractors of the field in plain PyTorch. They load the archives that their authors
publish; none ships.

To add an extractor, write a module with a function that loads it and add an entry to
``EXTRACTORS``.
"""

from functools import partial
from pathlib import Path

from lidar_synth.errors import ConfigError, DataError, FileError, choose
from lidar_synth.lab.evaluate.extractors import (
    bonnetal,
    liploc,
    pointnet,
    rangevit,
    voxel_networks,
)
from lidar_synth.lab.evaluate.extractors.specification import (
    FOLDER_VARIABLE,
    Extractor,
    ExtractorSpec,
)

__all__ = [
    "EXTRACTORS",
    "FOLDER_VARIABLE",
    "Extractor",
    "ExtractorSpec",
    "load_extractor",
]

_BONNETAL = (
    "https://github.com/PRBonn/lidar-bonnetal, its README, section Pre-trained Models"
)
_LIDM = (
    "https://github.com/hancyran/LiDAR-Diffusion, lidm/eval/README.md, section Model Zoo, 64-beam "
    "LiDAR"
)
_R2FLOW = "https://github.com/kazuto1011/r2flow, release 'weights'"
_R3DPA = "https://github.com/valeoai/R3DPA, its releases"
_SEMANTIC_KITTI = "that of SemanticKITTI: CC BY-NC-SA 4.0, non-commercial"
_UNSTATED = (
    "none stated for the weights (code: MIT); trained on SemanticKITTI, CC BY-NC-SA 4.0"
)

_SEGMENTER = (
    "arch_cfg.yaml",
    "data_cfg.yaml",
    "backbone",
    "segmentation_decoder",
    "segmentation_head",
)
_CHECKPOINT = ("config.yaml", "model.ckpt")


EXTRACTORS: dict[str, ExtractorSpec] = {
    "rangenet53": ExtractorSpec(
        "FRD",
        "range image",
        4096,
        ("darknet53-1024",),
        _SEGMENTER,
        _BONNETAL,
        _SEMANTIC_KITTI,
        partial(bonnetal.load_bonnetal, pool="subsample"),
        "r2flow",
    ),
    "rangenet21": ExtractorSpec(
        "FRD",
        "range image",
        4096,
        ("darknet21",),
        _SEGMENTER,
        _BONNETAL,
        _SEMANTIC_KITTI,
        partial(bonnetal.load_bonnetal, pool="subsample"),
        bonnetal.OWN_GRID,
    ),
    "squeezeseg": ExtractorSpec(
        "FRD",
        "range image",
        64,
        ("squeezeseg",),
        _SEGMENTER,
        _BONNETAL,
        _SEMANTIC_KITTI,
        partial(bonnetal.load_bonnetal, pool="returns"),
        bonnetal.OWN_GRID,
    ),
    "lidm_rangenet": ExtractorSpec(
        "FRID",
        "range image",
        512,
        ("rangenet",),
        ("config.yaml", "backbone", "segmentation_decoder"),
        _LIDM,
        _UNSTATED,
        bonnetal.load_lidm,
        "lidm",
    ),
    "r2flow_rangenet": ExtractorSpec(
        "FRID",
        "range image",
        512,
        ("rangenet21_lidm",),
        _SEGMENTER,
        _R2FLOW,
        _UNSTATED,
        partial(bonnetal.load_bonnetal, pool="bands", project="R2Flow"),
        "r2flow",
    ),
    "r3dpa_rangevit": ExtractorSpec(
        "FRID",
        "range image",
        1024,
        ("rangevit_wo_i",),
        _CHECKPOINT,
        _R3DPA,
        _UNSTATED,
        rangevit.load_rangevit,
        "r3dpa",
    ),
    "r3dpa_rangevit_remission": ExtractorSpec(
        "FRD",
        "range image",
        1024,
        ("rangevit_w_i",),
        _CHECKPOINT,
        _R3DPA,
        _UNSTATED,
        rangevit.load_rangevit,
        "r3dpa",
    ),
    "sparenet_pointnet": ExtractorSpec(
        "FPD",
        "cloud",
        1808,
        ("cls_model_39.pth",),
        ("cls_model_39.pth",),
        "https://github.com/microsoft/SpareNet, Frechet/cls_model_39.pth",
        "MIT; trained on ShapeNet",
        pointnet.load_pointnet,
        "r2flow",
        git_blob="c9e80093a093d5667e9aa705d87d923df50f1c25",
    ),
    "lidm_minkowski": ExtractorSpec(
        "FSVD",
        "cloud",
        768,
        ("minkowskinet", "minkowskinet_lidm"),
        _CHECKPOINT,
        f"{_LIDM}; or {_R2FLOW}",
        _UNSTATED,
        partial(voxel_networks.load_voxel_network, network="minkowski"),
        "lidm",
    ),
    "lidm_spvcnn": ExtractorSpec(
        "FPVD",
        "cloud",
        768,
        ("spvcnn", "spvcnn_lidm"),
        _CHECKPOINT,
        f"{_LIDM}; or {_R2FLOW}",
        _UNSTATED,
        partial(voxel_networks.load_voxel_network, network="spvcnn"),
        "lidm",
    ),
    "liploc": ExtractorSpec(
        "FLD",
        "range image",
        2048,
        ("liploc",),
        _CHECKPOINT,
        _R3DPA,
        _UNSTATED,
        liploc.load_liploc,
        "r3dpa",
    ),
}
"""Extractors by name."""


def load_extractor(
    name: str, path: Path | None = None, preparation: str | None = None
) -> Extractor:
    """Load an extractor from the archive that its authors publish, without running code from it.

    Args:
        name: a name of ``EXTRACTORS``.
        path: the archive, a folder with its files, or its one file; by default the one of the
            extractor's published name in the folder that LIDAR_SYNTH_METRICS names.
        preparation: how scans become inputs: a name of ``PREPARATIONS``; the extractor's own by
            default.

    Raises:
        ConfigError: on an unknown name, weights that are not there, or settings that are not
            supported.
        FileError: if a file cannot be read.
        DataError: on a damaged file, one that contains code, or weights of another architecture.
        LibraryError: if an optional library is missing.
    """
    spec = choose("extractor", name, EXTRACTORS)
    path = path or spec.found()
    if path is None:
        raise ConfigError(
            f"no weights of {name}",
            f"{' or '.join(spec.archives)} in the folder that {FOLDER_VARIABLE} names",
            "lidar-synth metrics setup says where to get them.",
        )
    try:
        return spec.load(Path(path), preparation or spec.preparation)
    except (ConfigError, DataError, FileError) as error:
        raise type(error)(
            str(error).removesuffix("."),
            hint=f"{name} takes {spec.archives[0]} of {spec.source}.",
        ) from error
