"""Uploads of banks to the Hugging Face hub."""

import hashlib
from dataclasses import replace
from pathlib import Path

from lidar_synth.bank.card import CARD, card_files
from lidar_synth.bank.folder import check_copy
from lidar_synth.bank.index import INDEX, Index
from lidar_synth.errors import ConfigError
from lidar_synth.files.disk import sha256
from lidar_synth.files.hub import Repository, push


def push_bank(
    root: str | Path, index: Index, name: str, licence: str | None, private: bool
) -> str:
    """Upload a bank; ``Bank.push_to_hub`` describes arguments and errors."""
    there = Repository("dataset", name)
    if isinstance(root, str):
        raise ConfigError(f"the bank at {root}", "one in a folder", "Copy it first.")
    for entry in index.shards:
        check_copy(str(root / entry.file), sha256(root / entry.file), entry)
    cards = card_files(name, index, str(there), licence)
    digests = {k: hashlib.sha256(text).hexdigest() for k, text in cards.items()}
    index = replace(index, files={**index.files, **digests})
    own = (*(entry.file for entry in index.shards), *(index.files.keys() - cards))
    card = cards.pop(CARD)
    files = {**{file: root / file for file in own}, **cards, INDEX: index.to_json()}
    return push(there, card, files, private)
