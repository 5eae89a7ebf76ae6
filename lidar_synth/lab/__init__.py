"""What makes, measures and proves: the town, training, measures, proofs, fitting of sensors,
curation, importers.

The rest of the package, which a training imports, never imports the laboratory: public names and
commands load it by name (``tests/test_structure.py``).
"""
