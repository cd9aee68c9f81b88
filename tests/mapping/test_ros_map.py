"""The files of ROS's map_server: there and back, pixel by pixel, and what is refused."""

import itertools
import string

import cv2
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvo360.checks import InputError
from torchvo360.mapping import FREE, OCCUPIED, UNKNOWN, OccupancyMap, read_map, unit_of_map, write_map

STATES = torch.tensor([[FREE, FREE, OCCUPIED], [UNKNOWN, OCCUPIED, UNKNOWN]], dtype=torch.int8)


@pytest.fixture
def written(tmp_path):
    return write_map(tmp_path, OccupancyMap(STATES, 0.05, (-1.25, 2.5)))


def changed(path, **new):
    before = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({key: value for key, value in {**before, **new}.items() if value is not None}))
    return path


@settings(deadline=None)  # the first one loads what reads YAML
@given(
    st.lists(st.lists(st.sampled_from([FREE, OCCUPIED, UNKNOWN]), min_size=3, max_size=3), min_size=1, max_size=5),
    st.floats(1e-4, 10),
    st.floats(-1e3, 1e3),
)
def test_a_map_comes_back_as_it_was(tmp_path_factory, cells, resolution, x):
    before = OccupancyMap(torch.tensor(cells, dtype=torch.int8), resolution, (x, -x))
    after = read_map(write_map(tmp_path_factory.mktemp("map"), before))
    torch.testing.assert_close(after.states, before.states)
    assert (after.resolution, after.origin) == (before.resolution, before.origin)


def test_the_image_is_that_of_map_saver_with_the_greatest_y_above(written):
    image = cv2.imread(str(written.with_name("map.pgm")), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.tolist() == [[205, 0, 205], [254, 254, 0]]
    assert yaml.safe_load(written.read_text()) == {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": 0.05,
        "origin": [-1.25, 2.5, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }


def test_another_unit_is_told_in_a_comment(tmp_path):
    path = write_map(tmp_path, OccupancyMap(STATES, 0.05), unit="units")
    assert path.read_text().startswith("# lengths are in units, not in metres\n")
    torch.testing.assert_close(read_map(path).states, STATES)
    assert unit_of_map(path) == "units"


def test_a_map_without_that_comment_is_in_metres(written):
    assert unit_of_map(written) == "m"
    written.write_text("# a hall\n" + written.read_text())
    assert unit_of_map(written) == "m"


def test_a_negated_image_and_one_with_comments_are_read(written):
    image = written.with_name("map.pgm")
    pixels = image.read_bytes()[-6:]
    image.write_bytes(b"P5 # made elsewhere\n3 2\n# another\n255\n" + bytes(255 - pixel for pixel in pixels))
    torch.testing.assert_close(read_map(changed(written, negate=1)).states, STATES)


def test_without_a_mode_a_map_is_trinary(written):
    torch.testing.assert_close(read_map(changed(written, mode=None)).states, STATES)


def test_places_and_cells_belong_together():
    map = OccupancyMap(STATES, 0.5, (1.0, -2.0))
    assert map.extent == (1.0, 2.5, -2.0, -1.0)
    assert map.cell_of((1.2, -1.9)) == (0, 0)
    assert map.cell_of((2.4, -1.1)) == (1, 2)
    assert map.cell_of((2.5, -1.1)) is None
    assert map.cell_of((0.99, -1.1)) is None
    assert map.centres(torch.tensor([1]), torch.tensor([2])).tolist() == [[2.25, -1.25]]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"image": None}, "no image"),
        ({"resolution": None}, "no resolution"),
        ({"resolution": 0}, "above 0"),
        ({"resolution": "fine"}, "a number for resolution"),
        ({"origin": [0, 0]}, "yaw"),
        ({"origin": [0, 0, 0.5]}, "yaw of 0"),
        ({"free_thresh": 0.9}, "free_thresh <= occupied_thresh"),
        ({"mode": "raw"}, "trinary or scale"),
        ({"image": "none.pgm"}, "map's image"),
        ({"image": "../elsewhere.pgm"}, "in the map's folder"),
        ({"image": "/etc/hostname"}, "in the map's folder"),
        ({"image": 3}, "name of an image"),
        ({"image": "a\0b"}, "name of an image"),
        ({"negate": "no"}, "negate 0 or 1"),
        ({"resolution": 10**400}, "a number for resolution"),
        ({"resolution": 1e300}, "at most 1e"),
        ({"origin": [10**400, 0, 0]}, "yaw"),
        ({"image": "map.yaml"}, "binary PGM"),
    ],
)
def test_a_map_that_is_none_is_refused_in_one_sentence(written, settings, told):
    with pytest.raises(InputError, match=told) as error:
        read_map(changed(written, **settings))
    assert str(error.value).count(". ") == 0


@pytest.mark.parametrize("text", ["[" * 5000, "resolution: 2001-99-99", "resolution: 1" + "0" * 5000, "a" * 100_000])
def test_yaml_that_no_reader_digests_is_refused(written, text):
    written.write_text(text)
    with pytest.raises(InputError, match="map's yaml file, got"):
        read_map(written)


def test_a_value_of_many_references_is_told_in_few_words(written):
    doubled = "".join(f"{new}: &{new} [*{old}, *{old}]\n" for old, new in itertools.pairwise(string.ascii_lowercase))
    written.write_text("a: &a [x, x]\n" + doubled + written.read_text().replace("mode: trinary", "mode: *z"))
    with pytest.raises(InputError, match="trinary or scale") as error:  # two to the 26th words in full
        read_map(written)
    assert len(str(error.value)) < 200 + len(str(written))


def test_damaged_files_are_refused(written, tmp_path):
    image = written.with_name("map.pgm")
    image.write_bytes(image.read_bytes()[:-2])
    with pytest.raises(InputError, match="cut off"):
        read_map(written)
    written.write_text("a: [b")
    with pytest.raises(InputError, match="another file"):
        read_map(written)
    written.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="another file"):
        read_map(written)
    with pytest.raises(InputError, match="got none"):
        read_map(tmp_path / "none.yaml")


def test_a_link_out_of_the_folder_is_refused(written, tmp_path_factory):
    image = written.with_name("map.pgm")
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "map.pgm"
    image.rename(elsewhere)
    image.symlink_to(elsewhere)
    with pytest.raises(InputError, match="in the map's folder"):
        read_map(written)


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    with pytest.raises(InputError, match="expected a folder"):
        write_map(tmp_path / "none", OccupancyMap(STATES, 1.0))


@pytest.mark.parametrize("states", [STATES[:0], STATES[0], STATES.float()])
def test_cells_of_another_shape_or_type_are_refused(states):
    with pytest.raises(InputError, match="states"):
        OccupancyMap(states, 1.0)
