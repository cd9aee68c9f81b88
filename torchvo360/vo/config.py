"""Settings of the odometry, composed of its parts' settings."""

from dataclasses import dataclass, field

from torchvo360.checks import InputError, check_finite_number
from torchvo360.depth import EpipolarConfig, FilterConfig
from torchvo360.motion import PoseFilterConfig
from torchvo360.vo.inertial import InertialConfig
from torchvo360.vo.keyframes.keyframe import MapConfig
from torchvo360.vo.loops import LoopConfig
from torchvo360.vo.sensor import SensorConfig
from torchvo360.vo.start.initialise import InitialiseConfig
from torchvo360.vo.track import TrackConfig
from torchvo360.window import TraceConfig, WindowConfig


@dataclass(kw_only=True)
class OdometryConfig:
    """Settings of the odometry."""

    coarsest_width: int = 64
    """Pyramid levels go down to about this width."""
    blur_px: float = 0.7
    """Smoothing of every frame: 0.5 for clean images, 0.7 for compressed video."""
    saturation: float = 252 / 255
    """Intensities at or above this are clipped and not used."""
    weak_inliers: float = 0.65
    """Share of agreeing gradient below which the other hypotheses are searched, and the frame is WEAK."""
    lost_inliers: float = 0.4
    """Share below which the frame is LOST: false minima reach 0.07, true ones on real video at least 0.74."""
    restart_after: int = 15
    """Lost frames in a row after which a new map is started and joined to the old one."""
    overlap: bool = True
    """Look for loops, and with `map.lag` make keyframes, in a second thread while the next frames are tracked. The
    results are the same bits either way."""
    smooth: bool = False
    """Smooth the finished trajectory by the filter of the motion, forwards and backwards in time (Rauch, Tung and
    Striebel): every pose as far as its alignment left it open. It takes 3 ms a frame."""
    initialise: InitialiseConfig = field(default_factory=InitialiseConfig)
    track: TrackConfig = field(default_factory=TrackConfig)
    map: MapConfig = field(default_factory=MapConfig)
    epipolar: EpipolarConfig = field(default_factory=EpipolarConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)
    trace: TraceConfig = field(default_factory=TraceConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    motion: PoseFilterConfig = field(default_factory=PoseFilterConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)

    def __post_init__(self) -> None:
        check_finite_number("blur_px", self.blur_px, above=-1e-9, at_most=5)
        check_finite_number("saturation", self.saturation, above=0)
        check_finite_number("weak_inliers", self.weak_inliers, above=0, at_most=1)
        check_finite_number("lost_inliers", self.lost_inliers, above=0, at_most=self.weak_inliers)
        if self.coarsest_width < 16:
            raise InputError(f"coarsest_width: expected at least 16, got {self.coarsest_width}.")
        if self.restart_after < 1:
            raise InputError(f"restart_after: expected at least 1, got {self.restart_after}.")
