"""The detector of ``tools/research/detector_trial.py``: its scans, its network, its score."""
