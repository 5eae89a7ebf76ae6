"""torch_cluster's name, which Pointcept imports; its models for scans do not call it.

torch_cluster is distributed as source only and takes half an hour to compile.
"""
