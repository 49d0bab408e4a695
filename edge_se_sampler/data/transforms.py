"""Folders with one transforms.json, as nerfstudio, instant-ngp and their many writers make them.

Some list which frames are for training and which are held out (nerfstudio's train_filenames and so on); in others all
are alike. Images that are listed, but not there, are left out: instant-ngp's own fox lists some.
"""

from __future__ import annotations

import os
from pathlib import Path

from edge_se_sampler.data.capture import SPLITS, Capture, Split, keep_existing
from edge_se_sampler.data.scene_file import JsonValue, quote, read_json
from edge_se_sampler.data.transforms_frames import Entry, listed_file, read_entries, read_frames


def transforms_path(folder: Path) -> Path:
    return folder / "transforms.json"


def read_transforms(folder: Path) -> Capture:
    """The frames of a folder whose images exist, in the order of their names, and how they are split if the json says
    so. InputError for a json that cannot be used, and where fewer than half of the images exist."""
    top = read_json(transforms_path(folder))
    listed = read_entries(top, folder)
    splits = _read_splits(top, listed)
    entries, left_out = keep_existing(listed, [entry.image for entry in listed], top.required("frames", "").location)
    entries.sort(key=lambda entry: entry.file_path)
    if others := top.optional("test_frames"):
        found = f"{len(others.list())} held-out images are left out: only frames are read"
        left_out.append(f"{others.location.file}: {others.location.field}: {found}")
    if splits is None:
        return Capture(read_frames(entries), left_out)
    keys = [_key(entry.file_path) for entry in entries]
    rows: dict[Split, list[int]] = {}
    for split, names in splits.items():
        rows[split] = [i for i, key in enumerate(keys) if key in names]
    return Capture(read_frames(entries), left_out, rows)


def _key(path: str) -> str:
    """One name for all spellings of a listed file."""
    return os.path.normpath(listed_file(path))


def _read_splits(top: JsonValue, entries: list[Entry]) -> dict[Split, set[str]] | None:
    """The files of each split; None if the json does not split them. What is in no list is trained on where there is
    no list of what is."""
    known = {_key(entry.file_path) for entry in entries}
    by_stem = {os.path.splitext(key)[0]: key for key in known}  # whose ending a list may leave out
    splits: dict[Split, set[str]] = {}
    of: dict[str, str] = {}
    for split in SPLITS:
        value = top.optional(f"{split}_filenames")
        for name in [] if value is None else value.list():
            key = _key(name.file_path())
            if key not in known:
                key = _key(name.file_path().replace("\\", "/"))  # written on Windows
            if key not in known:
                key = by_stem.get(os.path.splitext(key)[0], key)
            if key not in known:
                raise name.location.error(f"{quote(name.value)} is the file of no frame", "list files of frames")
            if "train" in (of.setdefault(key, split), split) and of[key] != split:
                problem = f"{quote(name.value)} is in {of[key]}_filenames, too"
                raise name.location.error(problem, "train on no image that is held out")
            splits.setdefault(split, set()).add(key)
    if not splits:
        return None
    splits.setdefault("train", known - set(of))
    return splits
