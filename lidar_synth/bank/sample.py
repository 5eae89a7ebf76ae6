"""The recorded scans that ship with the package."""

from importlib.resources import files
from pathlib import Path

from lidar_synth.bank.reader import Bank


def sample_scans() -> Bank:
    """Eight sweeps of a Pandar64, of one street in San Francisco, with labels and boxes.

    They are frames 0, 10, ... 70 of sequence 002 of PandaSet by Scale AI and Hesai, on the grid of
    the sensor, as measured. CC BY 4.0 with PandaSet's Dataset Terms, which ``README.md`` in the
    bank's folder (``root``) states: give the attribution with what you publish.

    Returns:
        The bank; its scans have the domain ``REAL``.

    Example:
        >>> from lidar_synth import sample_scans
        >>> scans = sample_scans()
        >>> len(scans), scans[0].id, sorted(scans.fields)
        (8, 'pandaset/2/0', ['boxes', 'instance', 'label', 'reflectance'])
        >>> scans[0].boxes.names.count("Car")
        63
    """
    return Bank(Path(str(files("lidar_synth"))) / "samples" / "pandaset")
