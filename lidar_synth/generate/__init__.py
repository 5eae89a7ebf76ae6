"""From a checkpoint to scans: the one place where geometry, networks and flow meet."""
