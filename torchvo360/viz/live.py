"""A run as it happens, in the Rerun viewer, and as a recording that the viewer opens later; needs the extra `live`.

`viz=rerun` writes the recording alone, which works without a display: `rerun run.rrd` shows it. `viz=rerun_viewer`
opens the viewer too and streams to it meanwhile. Camera, image, state and values appear with every frame as the
odometry gives them out; path and map appear every so many frames as they are known by then, and once more in the end,
with the loops' corrections. The world is that of trajectory.txt.
"""

import importlib.util
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from torchvo360.cameras import Camera, Equirectangular
from torchvo360.checks import InputError
from torchvo360.data.frame import Frame
from torchvo360.viz.report.pictures import encoded, picture_size
from torchvo360.vo import FrameEstimate, OdometryResult

if TYPE_CHECKING:
    from rerun import RecordingStream  # pyright: ignore[reportMissingImports]
    from rerun.blueprint import Blueprint  # pyright: ignore[reportMissingImports]

MAP_EVERY = 30
"""Frames between two looks at the map so far, which cost a search for loops each."""

VALUES = ("residual", "inliers", "a", "b", "milliseconds")

POINT_SIZE = 1.5
"""Pixels of the page."""


def can_record() -> bool:
    """Return whether the Rerun SDK is installed."""
    return importlib.util.find_spec("rerun") is not None


def image_of(camera: Camera) -> str:
    """Return where the images go: before the camera for a pinhole, beside the world for a panorama."""
    return "image" if isinstance(camera, Equirectangular) else "world/camera/image"


class LiveView:
    """Sends a run to Rerun, frame by frame."""

    def __init__(self, recording: "RecordingStream", camera: Camera, temporary: Path, final: Path) -> None:
        """Send what does not change.

        Args:
            recording: It writes into the temporary file.
            camera: Of all frames.
            temporary: Gets the final name when the run has come to its end.
            final: Where the recording is to be.
        """
        import rerun  # pyright: ignore[reportMissingImports]

        self._rr, self._recording, self._files = rerun, recording, (temporary, final)
        self._image = image_of(camera)
        self._said = ""
        self._keyframes: set[int] = set()
        recording.log("world", rerun.ViewCoordinates.RDF, static=True)
        if not isinstance(camera, Equirectangular):
            width, height = picture_size(camera.width, camera.height)
            fx, fy, cx, cy = camera.intrinsics
            sx, sy = width / camera.width, height / camera.height
            pinhole = rerun.Pinhole(
                focal_length=(fx * sx, fy * sy), principal_point=(cx * sx, cy * sy), resolution=(width, height)
            )
            recording.log(self._image, pinhole, static=True)

    def show(self, frame: Frame, estimate: FrameEstimate) -> None:
        """Send a frame with the odometry's answer to it."""
        rr, recording, T = self._rr, self._recording, estimate.T_world_cam
        self._at(estimate)
        recording.log("world/camera", rr.Transform3D(translation=T[:3, 3].numpy(), mat3x3=T[:3, :3].numpy()))
        if frame.image is not None and not frame.problem:
            recording.log(self._image, rr.EncodedImage(contents=encoded(frame.image), media_type="image/jpeg"))
        for name in VALUES:
            if math.isfinite(value := getattr(estimate, name)):
                recording.log(f"values/{name}", rr.Scalars(value))
        if (said := f"{estimate.state}: {estimate.reason}") != self._said:
            recording.log("states", rr.TextLog(said))
            self._said = said

    def show_map(self, result: OdometryResult) -> None:
        """Send the path so far, and the points of the keyframes that have not been sent."""
        self._at(result.frames[-1])
        self._recording.log("world/path", self._rr.LineStrips3D([result.trajectory.positions.numpy()]))
        frame, order = result.points.frame.sort(stable=True)
        keyframes, counts = frame.unique_consecutive(return_counts=True)
        for key, rows in zip(keyframes.tolist(), order.split(counts.tolist()), strict=True):
            if key not in self._keyframes:
                self._keyframes.add(key)
                points = self._rr.Points3D(
                    result.points.xyz[rows].numpy(),
                    colors=result.points.rgb[rows].numpy(),
                    radii=self._rr.Radius.ui_points(POINT_SIZE),
                )
                self._recording.log(f"world/map/{key}", points)

    def finish(self, result: OdometryResult) -> None:
        """Send the whole map and path as they are in the end, and complete the recording."""
        gone = self._keyframes - set(result.points.frame.tolist())
        self._keyframes.clear()
        self.show_map(result)
        for key in gone:  # of a map that was taken back
            self._recording.log(f"world/map/{key}", self._rr.Clear(recursive=False))
        self._recording.disconnect()
        os.replace(*self._files)

    def _at(self, estimate: FrameEstimate) -> None:
        self._recording.set_time("frame", sequence=estimate.index)
        self._recording.set_time("time", duration=estimate.t_ns / 1e9)


@contextmanager
def live_view(viz: str, path: Path, name: str, camera: Camera) -> Iterator[LiveView | None]:
    """Record a run while it lasts; the file appears when the view is told that the run has come to its end.

    Args:
        viz: none, which yields None and imports nothing, rerun or rerun_viewer.
        path: The recording to write.
        name: Of the run, which the viewer shows.
        camera: Of all frames.

    Raises:
        ModuleNotFoundError: The Rerun SDK is missing; the extra `live` brings it.
        InputError: The viewer is missing.
    """
    if viz == "none":
        yield None
        return
    try:
        import rerun  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("viz: expected rerun, which `pip install torchvo360[live]` brings.") from error
    temporary = path.with_name(f".{path.stem}.part{path.suffix}")
    recording = rerun.RecordingStream("torchvo360")
    recording.send_recording_name(name)
    sinks = [rerun.FileSink(temporary)]
    if viz == "rerun_viewer":
        try:
            recording.spawn(connect=False)
        except RuntimeError:
            raise InputError("viz: expected the command `rerun` on the PATH for rerun_viewer, got none.") from None
        sinks.append(rerun.GrpcSink())
    recording.set_sinks(*sinks, default_blueprint=_layout(camera))
    try:
        yield LiveView(recording, camera, temporary, path)
    finally:
        recording.disconnect()
        temporary.unlink(missing_ok=True)


def _layout(camera: Camera) -> "Blueprint":
    import rerun.blueprint as layout  # pyright: ignore[reportMissingImports]

    image = layout.Spatial2DView(origin=image_of(camera), name="Image")
    values = [layout.TimeSeriesView(origin=f"values/{name}", name=name) for name in VALUES]
    states = layout.TextLogView(origin="states", name="States")
    world = layout.Spatial3DView(origin="world", name="World")
    return layout.Blueprint(
        layout.Horizontal(world, layout.Vertical(image, layout.Tabs(*values, states)), column_shares=[3, 2])
    )
