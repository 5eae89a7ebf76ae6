"""lidar_synth: synthetic LiDAR scans for perception training.

Each name is imported when it is first used, so that ``import lidar_synth`` and the command line
start at once.

Example:
    >>> import lidar_synth
    >>> lidar_synth.__version__
    '0...'
    >>> scan = lidar_synth.Town(seed=0, scans=1)[0]
    >>> lidar_synth.project(scan).range.shape
    (64, 1024)
"""

from functools import partial
from typing import TYPE_CHECKING

from lidar_synth.errors import import_name
from lidar_synth.files.compiled import keep_compiled_code

keep_compiled_code()

__version__ = "0.1.0"

_HOME = {
    "Bank": "bank",
    "BatchMixer": "mixing.service",
    "Boxes": "geometry",
    "Compose": "labels.compose",
    "Generator": "generate.generator",
    "IgnoreLabels": "labels.own",
    "KITTI360": "formats",
    "KITTIObject": "formats",
    "KITTIRaw": "formats",
    "KeepBoxes": "labels.own",
    "KeepCondition": "labels.own",
    "KeepLabels": "labels.own",
    "LaserMix": "labels.mix",
    "Layout": "geometry.layout",
    "LidarSynthError": "errors",
    "Linear": "mixing",
    "MixedScans": "mixing",
    "MixedStream": "mixing",
    "NuScenes": "formats",
    "ObjectBank": "labels",
    "PandaSet": "formats",
    "PasteObjects": "labels.mix",
    "PolarMix": "labels.mix",
    "PolarMixOrLaserMix": "labels.mix",
    "PredictLabels": "labels.pseudo",
    "ProofSettings": "lab.proof",
    "RangeImage": "geometry",
    "RemoveLabels": "labels.own",
    "RollingBank": "mixing.service",
    "Scan": "geometry",
    "SemanticKITTI": "formats",
    "Sensor": "geometry",
    "SensorFit": "lab.fitting",
    "Skin": "lab.town",
    "Source": "geometry",
    "Sources": "mixing",
    "Town": "lab.town",
    "Trajectory": "geometry.deskew",
    "adapt": "lab.train.adaptation",
    "assign_beams": "geometry.assign",
    "deskew": "geometry.deskew",
    "evaluate": "lab.evaluate",
    "fit_sensor": "lab.fitting",
    "fit_skin": "lab.town",
    "layout_of": "geometry.layout",
    "load_generator": "generate.loading",
    "load_layout": "geometry.layout.files",
    "load_sensor": "geometry",
    "load_skin": "lab.town",
    "make_policy": "labels",
    "mix": "mixing.settings",
    "open_scans": "formats",
    "project": "geometry.projection",
    "prove": "lab.proof",
    "reskew": "geometry.deskew",
    "sample_scans": "bank.sample",
    "start": "lab.start",
    "unfold": "geometry.projection",
    "unproject": "geometry.projection",
}

__all__ = ["__version__", *_HOME]

if TYPE_CHECKING:
    from lidar_synth.bank import Bank as Bank
    from lidar_synth.bank.sample import sample_scans as sample_scans
    from lidar_synth.errors import LidarSynthError as LidarSynthError
    from lidar_synth.formats import (
        KITTI360 as KITTI360,
        KITTIObject as KITTIObject,
        KITTIRaw as KITTIRaw,
        NuScenes as NuScenes,
        PandaSet as PandaSet,
        SemanticKITTI as SemanticKITTI,
        open_scans as open_scans,
    )
    from lidar_synth.generate.generator import Generator as Generator
    from lidar_synth.generate.loading import load_generator as load_generator
    from lidar_synth.geometry.assign import assign_beams as assign_beams
    from lidar_synth.geometry.deskew import (
        Trajectory as Trajectory,
        deskew as deskew,
        reskew as reskew,
    )
    from lidar_synth.geometry.layout import (
        Layout as Layout,
        layout_of as layout_of,
    )
    from lidar_synth.geometry.layout.files import load_layout as load_layout
    from lidar_synth.geometry.projection import (
        project as project,
        unfold as unfold,
        unproject as unproject,
    )
    from lidar_synth.geometry.scan import (
        Boxes as Boxes,
        RangeImage as RangeImage,
        Scan as Scan,
        Source as Source,
    )
    from lidar_synth.geometry.sensor import (
        Sensor as Sensor,
        load_sensor as load_sensor,
    )
    from lidar_synth.lab.evaluate import evaluate as evaluate
    from lidar_synth.lab.fitting import (
        SensorFit as SensorFit,
        fit_sensor as fit_sensor,
    )
    from lidar_synth.lab.proof import (
        ProofSettings as ProofSettings,
        prove as prove,
    )
    from lidar_synth.lab.start import start as start
    from lidar_synth.lab.town import (
        Skin as Skin,
        Town as Town,
        fit_skin as fit_skin,
        load_skin as load_skin,
    )
    from lidar_synth.lab.train.adaptation import adapt as adapt
    from lidar_synth.labels import (
        ObjectBank as ObjectBank,
        make_policy as make_policy,
    )
    from lidar_synth.labels.compose import Compose as Compose
    from lidar_synth.labels.mix import (
        LaserMix as LaserMix,
        PasteObjects as PasteObjects,
        PolarMix as PolarMix,
        PolarMixOrLaserMix as PolarMixOrLaserMix,
    )
    from lidar_synth.labels.own import (
        IgnoreLabels as IgnoreLabels,
        KeepBoxes as KeepBoxes,
        KeepCondition as KeepCondition,
        KeepLabels as KeepLabels,
        RemoveLabels as RemoveLabels,
    )
    from lidar_synth.labels.pseudo import PredictLabels as PredictLabels
    from lidar_synth.mixing import (
        Linear as Linear,
        MixedScans as MixedScans,
        MixedStream as MixedStream,
        Sources as Sources,
    )
    from lidar_synth.mixing.service import (
        BatchMixer as BatchMixer,
        RollingBank as RollingBank,
    )
    from lidar_synth.mixing.settings import mix as mix


__getattr__ = partial(import_name, __name__, _HOME)


def __dir__() -> list[str]:
    return __all__
