"""The sequences of a benchmark: from a suite of the configuration, a list of one's own, or a folder.

A list is a YAML file: the entries of `sequences` name settings of a run each, those of `grid` are combined, and
`settings` holds for all of them:

    settings: {mask: "below:-60"}
    sequences:
      - {name: garden, input: garden.mp4, truth: garden.txt}
    grid:
      synthetic.world: [room, pillars]
"""

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from torchvo360.checks import InputError
from torchvo360.cli.configuration import PATHS, check_keys
from torchvo360.cli.overrides import quoted
from torchvo360.data.dataset import recognise
from torchvo360.data.folder import is_image_file
from torchvo360.data.table import read_text

PARTS = ("settings", "sequences", "grid")

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")

TRUTHS = ("groundtruth.txt", "truth.txt")
"""Names of a TUM file with the true poses in a folder of images; beside it or beside a video, it has their name."""


@dataclass(frozen=True)
class Sequence:
    """An input of the benchmark."""

    name: str
    """Of its folder among the results: letters, digits and `_ . + -`."""
    overrides: Mapping[str, str]
    """The settings of its runs by their keys, as Hydra's grammar writes them."""


def find_sequences(dataset: str, suites: Path) -> list[Sequence]:
    """Return the sequences that a word names, which have different names.

    Args:
        dataset: The name of a suite, a list (.yaml), the folder of a sequence, or a folder that holds sequences.
        suites: The folder of the suites.

    Raises:
        InputError: It is none of these, or damaged, or there is nothing in it.
    """
    path = Path(dataset).expanduser()
    if dataset in (names := sorted(suite.stem for suite in suites.glob("*.yaml"))):
        found = _read_list(suites / f"{dataset}.yaml")
    elif path.is_dir():
        found = _in_folder(path)
    elif path.suffix in (".yaml", ".yml") and path.is_file():
        found = _read_list(path)
    else:
        raise InputError(f"dataset: expected one of {', '.join(names)}, a folder or a list (.yaml), got {dataset}.")
    if not found:
        raise InputError(f"dataset: expected sequences in {dataset}, got none.")
    seen: set[str] = set()
    for sequence in found:
        if sequence.name in seen:
            raise InputError(f"dataset: expected a name of its own for every sequence, got {sequence.name} twice.")
        seen.add(sequence.name)
    return found


def _in_folder(folder: Path) -> list[Sequence]:
    """Return the folder itself as a sequence, or those inside: data sets, folders of images, and videos."""
    if _is_sequence(folder):
        return [_of_path(folder)]
    return [_of_path(path) for path in sorted(folder.iterdir()) if _is_sequence(path)]


def _is_sequence(path: Path) -> bool:
    if path.is_dir():
        return recognise(path) is not None or any(map(is_image_file, path.iterdir()))
    return path.suffix.lower() in VIDEO_SUFFIXES


def _of_path(path: Path) -> Sequence:
    overrides = {"input": quoted(str(path))}
    beside = path.with_name(f"{path.stem if path.is_file() else path.name}.txt")
    inside = [path / name for name in TRUTHS] if path.is_dir() and recognise(path) is None else []
    if truth := next((file for file in [*inside, beside] if file.is_file()), None):
        overrides["truth"] = quoted(str(truth))
    return Sequence(_safe_name(path.resolve().stem if path.is_file() else path.resolve().name), overrides)


def _read_list(path: Path) -> list[Sequence]:
    try:
        content = yaml.safe_load(read_text(path, "a list of sequences"))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise InputError(f"{path}{where}: expected a list of sequences in YAML, got a damaged file.") from None
    parts = {"sequences": content} if isinstance(content, list) else content
    if not isinstance(parts, dict) or not parts or set(parts) - set(PARTS):
        raise InputError(f"{path}: expected a list, or a mapping with {', '.join(PARTS)}, got something else.")
    common = _flattened(parts.get("settings") or {}, f"{path}, settings")
    entries = parts.get("sequences") or []
    if not isinstance(entries, list):
        raise InputError(f"{path}: expected a list under sequences, got something else.")
    found = [_of_entry(entry, common, f"{path}, sequence {number}", path) for number, entry in enumerate(entries, 1)]
    return [*found, *_of_grid(parts.get("grid") or {}, common, path)]


def _of_entry(entry: Any, common: Mapping[str, Any], where: str, path: Path) -> Sequence:
    settings = _flattened(entry, where)
    name = settings.pop("name", None)
    settings = {**common, **settings}
    if name is None and not settings.get("input"):
        raise InputError(f"{where}: expected at least `input` or `name`, got neither.")
    if name is None:
        name = Path(str(settings["input"])).stem
    return Sequence(_safe_name(str(name)), _as_overrides(settings, where, path.parent))


def _of_grid(grid: Any, common: Mapping[str, Any], path: Path) -> Iterator[Sequence]:
    """Yield a sequence for every combination of the values, named after them."""
    if not isinstance(grid, dict) or not all(isinstance(values, list) and values for values in grid.values()):
        raise InputError(f"{path}: expected lists of values by their keys under grid, got something else.")
    for values in itertools.product(*grid.values()) if grid else ():
        settings = {**common, **dict(zip(grid, values, strict=True))}
        yield Sequence(_safe_name("_".join(map(str, values))), _as_overrides(settings, f"{path}, grid", path.parent))


def _flattened(settings: Any, where: str, above: str = "") -> dict[str, Any]:
    if not isinstance(settings, dict) or not all(isinstance(key, str) for key in settings):
        raise InputError(f"{where}: expected settings by their keys, got {settings!r}.")
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        flat |= _flattened(value, where, f"{above}{key}.") if isinstance(value, dict) else {f"{above}{key}": value}
    return flat


def _as_overrides(settings: Mapping[str, Any], where: str, folder: Path) -> dict[str, str]:
    """Return settings as overrides; files are looked for beside the list first."""
    overrides = {}
    for key, value in settings.items():
        names_file = isinstance(value, str) and key in (*PATHS, "mask") and (folder / value).exists()
        overrides[key] = _as_text(str(folder / value) if names_file else value)
    try:
        check_keys([f"{key}={value}" for key, value in overrides.items()])
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return overrides


def _as_text(value: Any) -> str:
    """Return a value of YAML as Hydra's grammar writes it."""
    if isinstance(value, list):
        return f"[{','.join(map(_as_text, value))}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return quoted(value) if isinstance(value, str) else str(value)


def _safe_name(name: str) -> str:
    return re.sub(r"[^\w.+-]+", "_", name).strip(".") or "_"
