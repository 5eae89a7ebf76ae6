"""The detector of ``tools/detector_trial.py``: its scans, its network, its score."""
