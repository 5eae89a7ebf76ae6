"""Real runs of the trainers that take a mixture, one file for each; ``tools/try_trainers.py`` calls
them.

A file ``<name>.py`` has::

    TITLE = "OpenPCDet, PointPillars"                  the trainer in the table

    def rows(trial: Trial) -> Iterator[Row]:
        python = trial.environment("an_index_package") a fresh environment with lidar_synth and what
                                                       the trainer needs
        tree = trial.tree("OPENPCDET_ROOT")            a copy of the trainer's public source tree
        data = trial.data                              real scans, the town and a bank of synthetic
                                                       scans on disk
        expect = ["what the log must contain"]
        trial.type_page("train", python, "a_page", {"/data/mix.yaml": mixture}, expect=expect)
        ran = ["training", "validation"]
        yield trial.row("python train.py ...", ran, left_out="CUDA operators: spconv")

``type_page`` types the commands of the trainer's page as they stand in the Markdown, ``pip
install`` included.

It runs the trainer's own script, with validation. What a CPU cannot run is named in ``left_out``.
"""
