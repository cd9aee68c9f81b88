"""What `torchvo360-export` does: the run, its input, and the writing."""

import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm
from yaml import YAMLError

from torchvo360.checks import InputError, check_choice
from torchvo360.cli import overrides as ours
from torchvo360.cli.command import conf_folder
from torchvo360.cli.configuration import compose
from torchvo360.cli.export_settings import DATA_SETS, NAMES, ExportConfig, settings_of
from torchvo360.cli.jobs import run_one
from torchvo360.export import write_ply, write_tum
from torchvo360.export.cubemap import Views
from torchvo360.export.dataset import IMAGES, MASKS, Material, export_colmap, export_nerfstudio
from torchvo360.export.euroc import write_euroc
from torchvo360.export.folder import atomic_folder
from torchvo360.export.frusta import SUFFIXES, write_frusta
from torchvo360.export.kitti import poses_at, write_kitti
from torchvo360.export.nerfstudio import POINTS, TRANSFORMS
from torchvo360.export.recorded import Recorded, read_recorded
from torchvo360.opening import Opened, open_input
from torchvo360.outputs import output_folder
from torchvo360.settings import RunConfig

OURS = {IMAGES, MASKS, "sparse", TRANSFORMS, POINTS}
"""All that an exported folder holds."""

INPUT_KEYS = ("input", "mask", "resize", "camera", "rig", "stereo", "depth_scale", "start", "stop", "every", "fps")
INPUT_KEYS += ("synthetic",)
"""Settings of a run that say what its images are."""


def run(words: Sequence[str]) -> int:
    """Do what the words behind the command's name ask for, say what came of it, and return the exit code.

    Raises:
        InputError: The caller's mistake.
        SystemExit: It was stopped by SIGTERM.
    """
    settings, for_the_run = settings_of(words)
    with _sigterm_unwinds():
        print("\n".join(export(settings, for_the_run)))
    return 0


@contextmanager
def _sigterm_unwinds() -> Iterator[None]:
    """Let SIGTERM end the block as an exception does, so that what it began is cleared away."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def export(settings: ExportConfig, for_the_run: Sequence[str] = ()) -> list[str]:
    """Write a run's result in another format, making the run before where there is none, and return what to say.

    Args:
        settings: Of the export.
        for_the_run: Overrides of `torchvo360` for a run that is made.

    Raises:
        InputError: The caller's mistake; then nothing is written, and what was there is as before.
    """
    if settings.run is None:
        if settings.out is not None:
            _check_free(settings, Path(settings.out).expanduser())
            _check_writable(Path(settings.out).expanduser())
        folder = _make_run(settings, for_the_run)
    else:
        folder = Path(settings.run).expanduser()
    known = read_recorded(folder)
    out = folder / NAMES[settings.format] if settings.out is None else Path(settings.out).expanduser()
    _check_free(settings, out)
    try:
        notes = _write(settings, folder, known, out)
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"out: expected a place that can be written, got {out}: {why}.") from None
    return [*(f"note: {note}" for note in notes), f"{settings.format}: {out}"]


def _write(settings: ExportConfig, folder: Path, known: Recorded, out: Path) -> list[str]:
    if settings.format in DATA_SETS:
        return _write_data_set(settings, folder, known, out)
    out.parent.mkdir(parents=True, exist_ok=True)
    notes: list[str] = []
    if settings.format == "tum":
        write_tum(out, known.trajectory)
    elif settings.format == "euroc":
        write_euroc(out, known.trajectory)
    elif settings.format == "ply":
        write_ply(out, known.xyz, known.rgb, known.host)
    elif settings.format == "kitti":
        write_kitti(out, poses_at(known.trajectory, known.t_ns))
        between = len(known.t_ns) - len(known.trajectory)
        notes += [f"{between} frames without a pose got one between their neighbours'."] * bool(between)
    else:
        chosen, notes = known.chosen(settings.every)
        by_index = dict(zip(known.index.tolist(), known.t_ns.tolist(), strict=True))
        keep = {by_index[index] for index in chosen}
        which = [t_ns in keep for t_ns in known.trajectory.t_ns.tolist()]
        write_frusta(out, known.trajectory.T_world_cam[which])
    return notes


def _write_data_set(settings: ExportConfig, folder: Path, known: Recorded, out: Path) -> list[str]:
    frames, notes = known.chosen(settings.every)
    opened = _open(folder, settings.input)
    material = Material(opened.sequence, opened.mask, known, frames, settings.image)
    readings = 2 if settings.format == "colmap" else 1
    bar = tqdm(
        total=readings * len(known.index),
        desc=settings.format,
        unit="frame",
        disable=None if settings.progress else True,  # None: where standard error is no terminal
        leave=False,
    )
    with bar, atomic_folder(out) as temporary:
        if settings.format == "nerfstudio":
            return notes + export_nerfstudio(temporary, material, bar.update)
        views = Views.of(material.camera, faces=settings.faces, fov_deg=settings.fov, size=settings.size)
        return notes + export_colmap(temporary, material, views, bar.update)


def _open(folder: Path, moved_to: str | None) -> Opened:
    """Open the input of a run again, as it was opened then, without what only the odometry needs."""
    file = folder / "config.yaml"
    try:
        content = OmegaConf.load(file)
        if "input" not in content:
            raise ValueError("no input")
        config = OmegaConf.masked_copy(content, [key for key in INPUT_KEYS if key in content])  # pyright: ignore[reportArgumentType]
        settings = OmegaConf.merge(OmegaConf.structured(RunConfig), config)
    except OSError as error:
        raise InputError(f"run: expected {file}, got {error.strerror}.") from None
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        got = str(error).partition("\n")[0].rstrip(".")
        raise InputError(f"run: expected settings as torchvo360 writes them in {file}, got: {got}.") from None
    settings.imu = None
    if moved_to is not None:
        settings.input = moved_to
    try:
        return open_input(ours.resolved(settings))  # pyright: ignore[reportArgumentType]
    except InputError as error:
        if not str(error).startswith("input:"):
            raise
        complaint = str(error).rstrip(".")
        raise InputError(f"{complaint} (the input of the run in {folder}; input=PATH says where it is now).") from None


def _make_run(settings: ExportConfig, overrides: Sequence[str]) -> Path:
    """Make a run of `input` in runs/, say what came of it, and return its folder.

    Raises:
        InputError: The caller's mistake.
        SystemExit: It was stopped by a signal; its folder is kept as any run's is.
    """
    progress = [] if settings.progress else ["progress=false"]
    config = compose([f"input={settings.input}", *progress, *overrides], conf_folder())
    name = open_input(config).sequence.name
    with output_folder(None, name, overwrite=False) as folder:
        config.out = str(folder)
        code = run_one(config)
    if code > 128:
        raise SystemExit(code)
    return folder


def _check_free(settings: ExportConfig, out: Path) -> None:
    """Refuse a place where something is that is not to be replaced.

    Raises:
        InputError: There is such a thing.
    """
    if settings.format == "frusta":
        check_choice("out", out.suffix.lower(), SUFFIXES)
    if not out.exists():
        return
    is_folder = settings.format in DATA_SETS
    if out.is_dir() != is_folder:
        expected = "a folder" if is_folder else "a file"
        raise InputError(f"out: expected {expected} for format={settings.format}, got {out}, which is none.")
    held = {path.name for path in out.iterdir()} if is_folder else {out.name}
    if held and not settings.overwrite:
        raise InputError(f"out: expected a new name, or overwrite=true, got {out}, which is there.")
    if is_folder and (foreign := sorted(held - OURS)):
        raise InputError(f"out: expected a folder that an export wrote, got {out}, which holds {foreign[0]}.")


def _check_writable(out: Path) -> None:
    """Refuse a place that cannot be written before a run is made for it.

    Raises:
        InputError: It is such a one.
    """
    above = next(path for path in out.absolute().parents if path.exists())
    try:
        tempfile.TemporaryFile(dir=above).close()
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"out: expected a place that can be written, got {out}: {why}.") from None
