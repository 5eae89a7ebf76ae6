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

from importlib import import_module
from typing import TYPE_CHECKING, Any

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
    from lidar_synth.formats import KITTI360 as KITTI360
    from lidar_synth.formats import KITTIObject as KITTIObject
    from lidar_synth.formats import KITTIRaw as KITTIRaw
    from lidar_synth.formats import NuScenes as NuScenes
    from lidar_synth.formats import PandaSet as PandaSet
    from lidar_synth.formats import SemanticKITTI as SemanticKITTI
    from lidar_synth.formats import open_scans as open_scans
    from lidar_synth.generate.generator import Generator as Generator
    from lidar_synth.generate.loading import load_generator as load_generator
    from lidar_synth.geometry.assign import assign_beams as assign_beams
    from lidar_synth.geometry.deskew import Trajectory as Trajectory
    from lidar_synth.geometry.deskew import deskew as deskew
    from lidar_synth.geometry.deskew import reskew as reskew
    from lidar_synth.geometry.layout import Layout as Layout
    from lidar_synth.geometry.layout import layout_of as layout_of
    from lidar_synth.geometry.layout.files import load_layout as load_layout
    from lidar_synth.geometry.projection import project as project
    from lidar_synth.geometry.projection import unfold as unfold
    from lidar_synth.geometry.projection import unproject as unproject
    from lidar_synth.geometry.scan import Boxes as Boxes
    from lidar_synth.geometry.scan import RangeImage as RangeImage
    from lidar_synth.geometry.scan import Scan as Scan
    from lidar_synth.geometry.scan import Source as Source
    from lidar_synth.geometry.sensor import Sensor as Sensor
    from lidar_synth.geometry.sensor import load_sensor as load_sensor
    from lidar_synth.lab.evaluate import evaluate as evaluate
    from lidar_synth.lab.fitting import SensorFit as SensorFit
    from lidar_synth.lab.fitting import fit_sensor as fit_sensor
    from lidar_synth.lab.proof import ProofSettings as ProofSettings
    from lidar_synth.lab.proof import prove as prove
    from lidar_synth.lab.start import start as start
    from lidar_synth.lab.town import Skin as Skin
    from lidar_synth.lab.town import Town as Town
    from lidar_synth.lab.town import fit_skin as fit_skin
    from lidar_synth.lab.town import load_skin as load_skin
    from lidar_synth.lab.train.adaptation import adapt as adapt
    from lidar_synth.labels import ObjectBank as ObjectBank
    from lidar_synth.labels import make_policy as make_policy
    from lidar_synth.labels.compose import Compose as Compose
    from lidar_synth.labels.mix import LaserMix as LaserMix
    from lidar_synth.labels.mix import PasteObjects as PasteObjects
    from lidar_synth.labels.mix import PolarMix as PolarMix
    from lidar_synth.labels.mix import PolarMixOrLaserMix as PolarMixOrLaserMix
    from lidar_synth.labels.own import IgnoreLabels as IgnoreLabels
    from lidar_synth.labels.own import KeepBoxes as KeepBoxes
    from lidar_synth.labels.own import KeepCondition as KeepCondition
    from lidar_synth.labels.own import KeepLabels as KeepLabels
    from lidar_synth.labels.own import RemoveLabels as RemoveLabels
    from lidar_synth.labels.pseudo import PredictLabels as PredictLabels
    from lidar_synth.mixing import Linear as Linear
    from lidar_synth.mixing import MixedScans as MixedScans
    from lidar_synth.mixing import MixedStream as MixedStream
    from lidar_synth.mixing import Sources as Sources
    from lidar_synth.mixing.service import BatchMixer as BatchMixer
    from lidar_synth.mixing.service import RollingBank as RollingBank
    from lidar_synth.mixing.settings import mix as mix


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        from lidar_synth.errors import suggest

        hint = f". {suggest(name, _HOME)}".rstrip(". ")
        raise AttributeError(f"module 'lidar_synth' has no attribute {name!r}{hint}")
    return getattr(import_module(f"lidar_synth.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
