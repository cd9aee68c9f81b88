"""The page as a file: what it holds, that it asks for nothing, and that nothing in a name can act in it."""

import base64
import csv
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchvo360.cameras import Camera, Equirectangular, Pinhole
from torchvo360.checks import InputError
from torchvo360.cli import main
from torchvo360.data.frame import Frame
from torchvo360.data.trajectory import Trajectory
from torchvo360.lie import se3, se3_exp, so3_exp
from torchvo360.viz.report import Content, Picture, Pictures, write_report
from torchvo360.viz.report import page as page_module
from torchvo360.viz.report.axes import upright_axes
from torchvo360.viz.report.content import MOST_POINTS
from torchvo360.viz.report.pictures import WIDTH
from torchvo360.viz.report.reasons import MEANINGS
from torchvo360.vo import FrameEstimate, OdometryResult, PointCloud, State

NASTY = "</script><img src=x onerror=alert(1)><!-- {{script}} & \u2028 'walk\".mp4"

VOID = {"meta", "input", "img", "path", "circle", "br", "link"}


def picture(index: int, *, width: int = 64) -> Picture:
    """A panorama with a red square ahead, a green one to the right and blue above."""
    image = np.full((width // 2, width, 3), 90, np.uint8)
    image[: width // 10] = (220, 30, 30)
    image[width // 8 : 3 * width // 8, 7 * width // 16 : 9 * width // 16] = (20, 20, 230)
    image[width // 8 : 3 * width // 8, 11 * width // 16 : 13 * width // 16] = (20, 200, 20)
    return Picture(index, cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())


def walk(frames: int) -> Trajectory:
    """A curve ahead and to the right, the camera upright."""
    at = torch.linspace(0, 1, frames, dtype=torch.float64)
    zero = torch.zeros_like(at)
    R = so3_exp(torch.stack([zero, 0.5 * at, zero], -1))
    t = torch.stack([at * at, 0.05 * (9 * at).sin(), 3 * at], -1)
    return Trajectory((torch.arange(frames) * 50_000_000).long() + 5_000_000_000, se3(R, t))


def cloud(count: int) -> PointCloud:
    generator = torch.Generator().manual_seed(0)
    xyz = torch.rand(count, 3, generator=generator) * torch.tensor([6.0, 2, 8]) - torch.tensor([3.0, 1, 2])
    rgb = (torch.rand(count, 3, generator=generator) * 256).byte()
    return PointCloud(xyz, rgb, (torch.arange(count) * 30 // max(count, 1)).int())


def sample(
    frames: int = 40,
    *,
    name: str = "walk",
    truth: bool = True,
    points: int = 3000,
    camera: Camera | None = None,
    pictures: int = 20,
    notes: tuple[str, ...] = (),
) -> Content:
    """A run of this many frames from the tenth on, lost for a while."""
    trajectory = walk(frames)
    estimates = []
    for row, T in enumerate(trajectory.T_world_cam):
        lost = 15 <= row < 20
        state, reason = (State.LOST, "no_agreement") if lost else (State.TRACKING, "ok")
        values = [math.nan] * 4 if lost else [0.02 + 1e-4 * row, 0.9, 0.01 * math.sin(row), -0.003]
        t_ns = int(trajectory.t_ns[row])
        estimates.append(FrameEstimate(10 + row, t_ns, T, state, reason, *values, milliseconds=30.0 + row % 7))
    result = OdometryResult(estimates, trajectory, cloud(points), 4, trajectory, [], 1)
    summary = {
        "input": name,
        "keyframes": 4,
        "notes": list(notes),
        "states": {"tracking": frames},
        "settings": {"seed": 3, "vo": {"weak": 0.5, "name": None}},
        "versions": {"torch": "2"},
    }
    S = se3_exp(torch.tensor([3.0, -1, 2, 0.2, 2.0, -0.4], dtype=torch.float64))
    noise = se3_exp(1e-3 * torch.randn(frames, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    true_T = S @ trajectory.T_world_cam @ noise
    true_T[:, :3, 3] *= 2
    return Content(
        name=name,
        camera=camera or Equirectangular(64, 32),
        result=result,
        summary=summary,
        truth=Trajectory(trajectory.t_ns, true_T) if truth else None,
        pictures=[picture(10 + 2 * number) for number in range(pictures)],
        defaults={"seed": 0, "vo": {"weak": 0.5, "name": None}},
    )


class Page(HTMLParser):
    """The elements of a page, their attributes and what is in the scripts."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[tuple[str, str]] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.texts: dict[str, str] = {}
        self.ids: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append((tag, dict(attrs).get("id") or tag))

    def handle_startendtag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        if self.open:
            name = self.open[-1][1]
            self.texts[name] = self.texts.get(name, "") + data


def content_of(path: Path) -> dict:
    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(Page(path).texts["content"], parse_constant=refuse)


def array(field: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(field["base64"]), np.dtype(field["type"]).newbyteorder("<"))


@pytest.fixture
def write(tmp_path) -> Callable[..., Path]:
    def written(content: Content, **options) -> Path:
        write_report(tmp_path / "report.html", content, **options)
        assert {path.name for path in tmp_path.iterdir()} == {"report.html"}
        return tmp_path / "report.html"

    return written


def test_the_page_is_one_well_formed_file_that_asks_for_nothing(write):
    path = write(sample())
    page, text = Page(path), path.read_text(encoding="utf-8")
    assert len(page.ids) == len(set(page.ids))
    assert not [a for a in page.attributes if a[1] in ("src", "href", "srcset", "action", "data")]
    assert not [a for a in page.attributes if a[1].startswith("on")]
    text = text.replace(page.texts["content"], "")
    assert not re.search(r"https?:|//[a-z]|url\(|@import|\bfetch\(|XMLHttpRequest|WebSocket|import\(", text)
    (policy,) = [value for tag, name, value in page.attributes if tag == "meta" and value.startswith("default-src")]
    assert policy.startswith("default-src 'none';")


def test_every_part_of_the_template_is_used():
    template = (page_module.TEMPLATE / "page.html").read_text()
    assert set(re.findall(r"\{\{(\w+)\}\}", template)) == {"title", "style", "content", "script"}
    files = {path.name for path in page_module.TEMPLATE.iterdir()}
    assert files == {"page.html", "style.css", *page_module.SCRIPTS}


def test_every_element_that_the_scripts_look_for_is_there(write):
    page = Page(write(sample()))
    scripts = "".join((page_module.TEMPLATE / name).read_text() for name in page_module.SCRIPTS)
    wanted = set(re.findall(r"element\(\"([\w-]+)\"\)", scripts))
    assert len(wanted) > 20
    assert wanted <= set(page.ids)


def test_names_from_outside_cannot_act(write):
    nasty = sample(name=NASTY, notes=(NASTY,))
    nasty.summary["settings"][NASTY] = NASTY
    path = write(nasty)
    page = Page(path)
    assert NASTY not in path.read_text(encoding="utf-8")
    assert [tag for tag, name, _ in page.attributes if name == "onerror"] == []
    assert page.texts["title"] == f"{NASTY} · torchvo360"
    shown = content_of(path)
    assert shown["name"] == shown["summary"]["notes"][0] == NASTY
    assert [NASTY, NASTY, False] in shown["settings"]
    scripts = "".join((page_module.TEMPLATE / name).read_text() for name in page_module.SCRIPTS)
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function", scripts)


def test_frames_are_those_of_the_run_and_missing_numbers_are_nan(write):
    content = sample()
    shown = content_of(write(content))["frames"]
    frames = content.result.frames
    assert array(shown["index"]).tolist() == [frame.index for frame in frames]
    np.testing.assert_allclose(array(shown["seconds"]), [(f.t_ns - frames[0].t_ns) / 1e9 for f in frames], atol=1e-12)
    assert [shown["states"][k] for k in array(shown["state"])] == [str(frame.state) for frame in frames]
    assert [shown["reasons"][k] for k in array(shown["reason"])] == [[f.reason, MEANINGS[f.reason]] for f in frames]
    for name in ("residual", "inliers", "a", "b", "milliseconds"):
        np.testing.assert_array_equal(
            array(shown[name]), np.array([getattr(frame, name) for frame in frames], np.float32)
        )
    assert np.isnan(array(shown["residual"])).sum() == 5
    positions = array(shown["position"]).reshape(-1, 3)
    np.testing.assert_allclose(positions, content.result.trajectory.positions, atol=1e-6)


def test_errors_are_against_the_truth_and_nan_where_it_is_silent(write):
    content = sample()
    assert content.truth is not None
    content = replace(content, truth=Trajectory(content.truth.t_ns[::2], content.truth.T_world_cam[::2]))
    shown = content_of(write(content))
    position_m, rotation_deg = (array(shown["errors"][name]) for name in ("position_m", "rotation_deg"))
    assert np.isfinite(position_m).sum() == np.isfinite(rotation_deg).sum() == 20
    assert 0 < np.nanmax(position_m) < 0.02
    assert 0 < np.nanmax(rotation_deg) < 0.5
    assert shown["unit"] == "m"


def test_without_truth_there_are_no_errors_and_the_unit_is_metres_only_where_it_is(write):
    shown = content_of(write(sample(truth=False)))
    assert (shown["errors"], shown["truth"], shown["unit"]) == (None, None, "units")
    assert content_of(write(replace(sample(truth=False), metric=True)))["unit"] == "m"


def test_estimate_and_truth_lie_on_one_another_where_they_are_shown(write):
    shown = content_of(write(sample()))
    S = np.array(shown["view_world"]).reshape(4, 4)
    path = array(shown["frames"]["position"]).reshape(-1, 3) @ S[:3, :3].T + S[:3, 3]
    np.testing.assert_allclose(array(shown["truth"]["shown"]).reshape(-1, 3), path, atol=0.02)
    np.testing.assert_allclose(path[0], 0, atol=1e-5)


def test_only_settings_that_are_not_the_usual_ones_are_marked(write):
    rows = content_of(write(sample()))["settings"]
    assert rows == [["seed", "3", False], ["vo.weak", "0.5", True], ["vo.name", "null", True]]


def test_without_truth_the_view_stands_upright_at_the_first_camera():
    trajectory = walk(30)
    tilt = so3_exp(torch.tensor([0.3, 1.0, -0.4], dtype=torch.float64))
    turned = Trajectory(trajectory.t_ns, se3(tilt, torch.ones(3, dtype=torch.float64)) @ trajectory.T_world_cam)
    R_view_cam = upright_axes(turned) @ turned.T_world_cam[0, :3, :3]
    torch.testing.assert_close(R_view_cam, torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0), (0.3, -2, 0.1)])
def test_known_gravity_gives_the_height_and_the_axes_are_no_mirror(up):
    direction = torch.tensor(up, dtype=torch.float64)  # the first is where the camera looks
    R = upright_axes(walk(5), direction)
    torch.testing.assert_close(R @ direction, torch.tensor([0, 0, float(direction.norm())], dtype=torch.float64))
    assert float(torch.linalg.det(R)) == pytest.approx(1)


def test_points_are_thinned_and_those_that_are_not_finite_left_out(write):
    content = sample(points=MOST_POINTS + 5000, pictures=0)
    content.result.points.xyz[7] = math.nan
    points = content_of(write(content))["points"]
    xyz = array(points["xyz"]).reshape(-1, 3)
    assert points["total"] == MOST_POINTS + 5000
    assert len(xyz) == len(array(points["frame"])) == len(array(points["eye_level"])) == MOST_POINTS
    assert np.isfinite(xyz).all()
    assert array(points["frame"]).max() == 29  # from the whole run


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_a_short_run_without_map_and_without_pictures_has_a_page(write, frames):
    shown = content_of(write(sample(frames, truth=False, points=0, pictures=0)))
    assert array(shown["frames"]["index"]).tolist() == list(range(10, 10 + frames))
    assert shown["points"]["total"] == 0
    assert shown["pictures"] == []


def test_a_page_drops_every_other_picture_until_it_is_as_small_as_asked(write):
    content = replace(sample(), pictures=[picture(10 + k, width=512) for k in range(40)])
    whole = write(content).stat().st_size
    most = whole - 1
    path = write(content, most_bytes=most)
    assert path.stat().st_size <= most
    assert [p["index"] for p in content_of(path)["pictures"]] == list(range(10, 50, 2))
    assert content_of(write(content, most_bytes=1000))["pictures"] == []


def test_nothing_is_shown_of_no_frames():
    with pytest.raises(InputError, match=r"^result: expected at least one frame"):
        replace(sample(), result=replace(sample().result, frames=[]))


# Pictures


def frame(index: int, *, width: int = 64, problem: str = "") -> Frame:
    noise = np.random.default_rng(index).integers(0, 256, (width // 2, width, 3), dtype=np.uint8)
    return Frame(index, index, noise, problem)


@pytest.mark.parametrize("length", [None, 100, 1000])
@pytest.mark.parametrize("count", [1, 15, 16, 17, 100, 333])
def test_pictures_are_bounded_and_evenly_spread(length, count):
    pictures = Pictures(10**9, most=16, length=length)
    for index in range(count):
        pictures.add(frame(index))
    kept = [picture.index for picture in pictures.kept]
    assert kept[0] == 0
    assert len(kept) <= 16
    if length is None or length <= count:
        assert len(kept) >= min(count, 8)
    assert len(set(np.diff(kept))) <= 1


def test_pictures_keep_to_their_bytes_and_leave_out_what_cannot_be_used():
    pictures = Pictures(20_000)
    for index in range(60):
        pictures.add(frame(index, problem="black" if index == 0 else ""))
    sizes = [len(picture.jpeg) for picture in pictures.kept]
    assert sum(sizes) <= 20_000 < 3 * sum(sizes)
    assert 0 not in {picture.index for picture in pictures.kept}


def test_wide_frames_are_brought_down_and_keep_their_colours():
    pictures = Pictures(10**9)
    image = np.zeros((1000, 2000, 3), np.uint8)
    image[..., 0] = 200
    pictures.add(Frame(0, 0, image))
    (kept,) = pictures.kept
    decoded = cv2.imdecode(np.frombuffer(kept.jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert decoded.shape == (WIDTH // 2, WIDTH, 3)
    np.testing.assert_allclose(decoded.reshape(-1, 3).mean(0), [0, 0, 200], atol=4)  # blue first


# By the command

SMALL = ["input=synthetic", "synthetic.width=128", "synthetic.height=64", "synthetic.frames=8", "plot=false"]


def test_a_run_leaves_its_page_with_the_numbers_of_its_other_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*SMALL, "out=x"]) == 0
    assert "report: x/report.html\nresults: x\n" in capsys.readouterr().out
    shown = content_of(Path("x/report.html"))
    rows = list(csv.DictReader(Path("x/frames.csv").read_text().splitlines()))
    frames = shown["frames"]
    for name in ("residual", "inliers", "a", "b", "milliseconds"):
        expected = [float(row[name]) if row[name] else math.nan for row in rows]
        np.testing.assert_allclose(array(frames[name]), expected, rtol=1e-5)
    assert [frames["states"][k] for k in array(frames["state"])] == [row["state"] for row in rows]
    table = np.loadtxt("x/trajectory.txt")
    np.testing.assert_allclose(array(frames["position"]).reshape(-1, 3), table[:, 1:4], atol=1e-6)
    np.testing.assert_allclose(array(frames["rotation"]).reshape(-1, 4), table[:, 4:], atol=1e-6)
    assert shown["summary"]["ate_rmse_m"] == json.loads(Path("x/summary.json").read_text())["ate_rmse_m"]
    assert [p["index"] for p in shown["pictures"]] == list(range(8))
    assert ["synthetic.width", "128", False] in shown["settings"]


def test_a_run_without_a_page_takes_an_older_one_away(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*SMALL, "out=x"]) == 0
    assert main([*SMALL, "out=x", "overwrite=true", "report=false"]) == 0
    assert "report:" not in capsys.readouterr().out.partition("results:")[2]
    assert not Path("x/report.html").exists()


def test_a_pinhole_run_says_what_it_looks_through(write):
    camera = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)
    assert content_of(write(sample(camera=camera)))["camera"] == {
        "panorama": False,
        "width": 64,
        "height": 48,
        "intrinsics": [50.0, 50.0, 32.0, 24.0],
    }
