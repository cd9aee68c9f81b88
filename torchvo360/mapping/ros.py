"""Maps as the pair of files that ROS's map_server reads: `map.pgm` and `map.yaml`.

Source: the map_server and nav2_map_server packages: an image whose first row has the greatest y, 0 for occupied, 254
for free and 205 for unknown, `origin` the pose of its lower left corner. Their unit is the metre.
"""

import re
import reprlib
import sys
from pathlib import Path
from typing import Any

import torch
import yaml

from torchvo360.checks import InputError
from torchvo360.files import write_atomically
from torchvo360.mapping.grid import FREE, MOST_CELLS, OCCUPIED, UNKNOWN, OccupancyMap

PIXELS = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196

MOST_TEXT = 65_536
"""Characters of a yaml file or of an image's header; a real one has some hundred."""

OTHER_UNIT = "# lengths are in {}, not in metres\n"

REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


def write_map(folder: str | Path, occupancy: OccupancyMap, *, name: str = "map", unit: str = "m") -> Path:
    """Write `<name>.pgm`, then `<name>.yaml`, each complete or not at all, and return the latter's path.

    Another unit than the metre, which ROS does not know, is said in a comment.

    Raises:
        InputError: They cannot be written.
    """
    image, path = Path(folder, f"{name}.pgm"), Path(folder, f"{name}.yaml")
    pixels = torch.full(occupancy.shape, PIXELS[UNKNOWN], dtype=torch.uint8)
    for state in (FREE, OCCUPIED):
        pixels[occupancy.states == state] = PIXELS[state]
    rows, columns = occupancy.shape
    write_atomically(image, b"P5\n%d %d\n255\n" % (columns, rows) + pixels.flip(0).numpy().tobytes())
    x, y = occupancy.origin
    settings = {
        "image": image.name,
        "mode": "trinary",
        "resolution": occupancy.resolution,
        "origin": [x, y, 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESH,
        "free_thresh": FREE_THRESH,
    }
    comment = "" if unit == "m" else OTHER_UNIT.format(unit)
    write_atomically(path, comment + yaml.safe_dump(settings, sort_keys=False, default_flow_style=None))
    return path


def read_map(path: str | Path) -> OccupancyMap:
    """Read a map as map_server does, modes trinary and scale; the image lies in the folder of the yaml file.

    Raises:
        InputError: A file is missing or not of the format, or the map is turned.
    """
    path = Path(path).expanduser()
    settings = _settings(path, _text(path))
    occupied_above, free_below = (_number(path, settings, key) for key in ("occupied_thresh", "free_thresh"))
    resolution = _number(path, settings, "resolution")
    origin = settings["origin"]
    if not (isinstance(origin, list) and len(origin) == 3 and all(_is_number(value) for value in origin)):
        raise InputError(f"{path}: expected origin: [x, y, yaw], got {_shown(origin)}.")
    if resolution <= 0 or origin[2] != 0:
        raise InputError(f"{path}: expected a resolution above 0 and a yaw of 0, got {resolution:g} and {origin[2]:g}.")
    if not 0 <= free_below <= occupied_above <= 1:
        got = f"{free_below:g} and {occupied_above:g}"
        raise InputError(f"{path}: expected 0 <= free_thresh <= occupied_thresh <= 1, got {got}.")
    if settings.get("mode", "trinary") not in ("trinary", "scale"):
        raise InputError(f"{path}: expected mode trinary or scale, got {_shown(settings['mode'])}.")
    if settings["negate"] not in (0, 1):
        raise InputError(f"{path}: expected negate 0 or 1, got {_shown(settings['negate'])}.")
    pixels = _pixels(_beside(path, settings["image"])).flip(0).double()
    occupied = (pixels if settings["negate"] else 255 - pixels) / 255
    states = torch.full(pixels.shape, UNKNOWN, dtype=torch.int8)
    states[occupied > occupied_above] = OCCUPIED
    states[occupied < free_below] = FREE
    return OccupancyMap(states, resolution, (float(origin[0]), float(origin[1])))


def unit_of_map(path: str | Path) -> str:
    """Return the unit of a map's lengths: the metre, unless the comment of `write_map` names another.

    Raises:
        InputError: The file cannot be read.
    """
    found = re.match(OTHER_UNIT.format(r"(\w+)"), _text(Path(path).expanduser()))
    return "m" if found is None else found[1]


def _text(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(MOST_TEXT + 1)
    except (OSError, ValueError) as error:  # ValueError: not UTF-8, or a zero byte in the name
        if isinstance(error, OSError):
            raise InputError(f"{path}: expected a map's yaml file, got none: {error.strerror}.") from None
        raise InputError(f"{path}: expected a map's yaml file, got another file.") from None
    if len(text) > MOST_TEXT:
        raise InputError(f"{path}: expected a map's yaml file, got one of more than {MOST_TEXT} characters.")
    return text


def _settings(path: Path, text: str) -> dict[str, Any]:
    try:
        settings = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):  # an impossible date or number, brackets without end
        raise InputError(f"{path}: expected a map's yaml file, got another file.") from None
    missing = [key for key in REQUIRED if not isinstance(settings, dict) or key not in settings]
    if missing:
        raise InputError(f"{path}: expected the keys of a map, got no {missing[0]}.")
    return settings


def _shown(value: Any) -> str:
    """Return a value's beginning, for a message."""
    return reprlib.repr(value)[:60]


def _is_number(value: Any) -> bool:
    """Return whether a value is a finite number that has a float."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _number(path: Path, settings: dict[str, Any], key: str) -> float:
    if not _is_number(settings[key]):
        raise InputError(f"{path}: expected a number for {key}, got {_shown(settings[key])}.")
    return float(settings[key])


def _beside(path: Path, image: Any) -> Path:
    """Return the image's path, which must not lead out of the map's folder."""
    if not isinstance(image, str) or not image or "\0" in image:
        raise InputError(f"{path}: expected the name of an image, got {_shown(image)}.")
    found = (path.parent / image).resolve()
    if not found.is_relative_to(path.parent.resolve()):
        raise InputError(f"{path}: expected an image in the map's folder, got {image}.")
    return found


def _pixels(path: Path) -> torch.Tensor:
    """Read a binary PGM of 8 bits."""
    try:
        with path.open("rb") as file:
            data = file.read(MOST_TEXT + MOST_CELLS)
    except OSError as error:
        raise InputError(f"{path}: expected a map's image, got none: {error.strerror}.") from None
    blank = rb"(?:\s|#[^\n]*\n)+"
    head = re.match(rb"P5" + blank + rb"(\d{1,6})" + blank + rb"(\d{1,6})" + blank + rb"255\s", data)
    if head is None:
        raise InputError(f"{path}: expected a binary PGM image of 8 bits, got another file.")
    columns, rows = int(head[1]), int(head[2])
    if not 0 < rows * columns <= MOST_CELLS:
        raise InputError(f"{path}: expected 1 to {MOST_CELLS} cells, got {columns} x {rows}.")
    body = data[head.end() :]
    if len(body) < rows * columns:
        raise InputError(f"{path}: expected {columns} x {rows} pixels, got {len(body)}: the file is cut off.")
    return torch.frombuffer(bytearray(body[: rows * columns]), dtype=torch.uint8).view(rows, columns)
