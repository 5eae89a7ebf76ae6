"""Fuzzing of the readers: valid files are mutated in a reproducible way, and each reader has to
read them soundly or refuse them with one of the package's errors, within limits of memory and time.

- ``mutators``: bytes in, other bytes out; the table by suffix, and what applies to every file.
- ``text``, ``arrays``, ``pictures``, ``containers``, ``hdf5``, ``weights``: mutators that know a
  format.
- ``targets``: the readers, one line each. To fuzz a new format, add a line there.
- ``checks``: what a result that was read has to be.
- ``worker``, ``run``: a process that reads case after case under a limit, and the one that watches
  it.
"""
