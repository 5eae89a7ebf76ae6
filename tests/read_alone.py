"""Read banks and planned epochs with a copy of ``reader.py`` alone, and compare them with expected
arrays, bit for bit.

    python read_alone.py FOLDER_OF_READER CASES

Python 3.8 and numpy are enough. ``reader_cases.write_cases`` writes CASES with the package.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, sys.argv[1])
import reader


def compare(where, found, expected):
    """All arrays have to be equal: names, shapes, types, bits."""
    assert set(found) == set(expected), (where, set(found) ^ set(expected))
    for name, value in expected.items():
        same = found[name].dtype == value.dtype and found[name].shape == value.shape
        assert same and found[name].tobytes() == value.tobytes(), (where, name)


def scan_arrays(scan):
    """The values of a scan that are not None."""
    return {
        name: np.asarray(value)
        for name, value in scan._asdict().items()
        if value is not None
    }


def main():
    """Compares all cases."""
    cases = Path(sys.argv[2])
    scans = 0
    samples = 0
    for folder in sorted((cases / "banks").iterdir()):
        bank = reader.Bank(folder / "bank")
        found = {}
        bank.verify()
        for number in range(len(bank)):
            found.update(
                {f"{number} image {name}": v for name, v in bank.image(number).items()}
            )
            found.update(
                {f"{number} {name}": v for name, v in scan_arrays(bank[number]).items()}
            )
        compare(folder.name, found, dict(np.load(str(folder / "expected.npz"))))
        scans += len(bank)
    for folder in sorted((cases / "plans").iterdir()):
        name, real = (folder / "bank.txt").read_text().splitlines()
        bank = reader.Bank(cases / "banks" / name / "bank")
        train = reader.MixedEpochs(folder / "plan.npz", range(int(real)), bank)
        found = {}
        for epoch in range(len(train.settings["lengths"])):
            train.set_epoch(epoch)
            for position in range(len(train)):
                sample = train[position]
                values = (
                    {"real": np.array(sample)}
                    if isinstance(sample, int)
                    else scan_arrays(sample)
                )
                found.update(
                    {
                        f"{epoch} {position} {key}": value
                        for key, value in values.items()
                    }
                )
                assert train.domain(position) == (not isinstance(sample, int))
                samples += 1
        compare(folder.name, found, dict(np.load(str(folder / "expected.npz"))))
    heavy = {"torch", "numba", "deflate", "lidar_synth"} & set(sys.modules)
    assert not heavy, heavy
    python, h5py = sys.version.split()[0], reader.h5py.__version__
    versions = f"Python {python}, numpy {np.__version__}, h5py {h5py}"
    print(f"{versions}: {scans} scans and {samples} samples are equal, bit for bit")


if __name__ == "__main__":
    main()
