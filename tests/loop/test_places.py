"""Places: yaw-invariance, brightness, what is not a place, and the index."""

import itertools
import math

import pytest
import torch

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.checks import InputError, ShapeError
from torchvo360.loop import PlaceIndex, describe_place, place_similarity
from torchvo360.loop.places import DESCRIPTOR_SIZE, MIN_SIMILARITY

CAMERA = Equirectangular(512, 256)


def similarity(first, second, *, wraps: bool = True) -> tuple[float, float]:
    value, yaw = place_similarity(first, second[None], yaw_invariant=wraps)
    return float(value[0]), float(yaw[0])


@pytest.mark.parametrize("columns", [0, 8, 256, 500, 511])
def test_a_place_is_the_same_whichever_way_the_camera_faces(room, columns):
    grey, _ = room.look(room.pose())
    value, yaw = similarity(describe_place(grey.roll(columns, 1), CAMERA), describe_place(grey, CAMERA))
    assert value > 0.97
    expected = math.remainder(columns / 512 * math.tau, math.tau)
    assert abs(math.remainder(yaw - expected, math.tau)) < math.tau / 64 * 0.51


def test_whole_columns_of_the_small_image_change_nothing_at_all(room):
    grey, _ = room.look(room.pose())
    value, _ = similarity(describe_place(grey.roll(8 * 13, 1), CAMERA), describe_place(grey, CAMERA))
    assert value == pytest.approx(1.0, abs=1e-4)


def test_a_turned_camera_is_turned_by_the_yaw_that_is_returned(room):
    place, _ = room.look(room.pose())
    query, _ = room.look(room.pose(yaw=math.pi / 2))
    value, yaw = similarity(describe_place(query, CAMERA), describe_place(place, CAMERA))
    # A camera turned to its left sees the same things further to its right: R_query_place turns z towards x.
    assert value > 0.97
    assert yaw == pytest.approx(math.pi / 2, abs=0.05)


@pytest.mark.parametrize(("gain", "offset"), [(4.0, 0.0), (0.25, 0.0), (0.6, 0.3)])
def test_gain_and_offset_do_not_count(room, gain, offset):
    grey, _ = room.look(room.pose())
    value, _ = similarity(describe_place(grey * gain + offset, CAMERA), describe_place(grey, CAMERA))
    assert value > 0.999


@pytest.mark.parametrize("world", ["room", "courtyard", "pillars"])
def test_a_displaced_and_tilted_camera_is_known_again_and_other_places_are_not(world, request):
    studio = request.getfixturevalue(world)
    place = describe_place(studio.look(studio.pose())[0], CAMERA)
    near = describe_place(studio.look(studio.pose((0.1, -0.15, 0.03), yaw=2.0, tilt=(0.04, -0.04)))[0], CAMERA)
    far = describe_place(studio.look(studio.pose(at=math.pi))[0], CAMERA)
    assert similarity(near, place)[0] > MIN_SIMILARITY + 0.1
    assert similarity(far, place)[0] < similarity(near, place)[0]


def test_black_white_and_unknown_images_are_like_nothing(room):
    grey, _ = room.look(room.pose())
    place = describe_place(grey, CAMERA)
    for image in (torch.zeros_like(grey), torch.ones_like(grey), torch.full_like(grey, torch.nan)):
        descriptor = describe_place(image, CAMERA)
        assert bool((descriptor == 0).all())
        assert similarity(descriptor, place)[0] == 0


def test_masked_pixels_do_not_count_whatever_they_hold(room):
    grey, _ = room.look(room.pose())
    known = torch.ones_like(grey, dtype=torch.bool)
    known[200:] = False
    noise = torch.rand(grey.shape, generator=torch.Generator().manual_seed(0))
    first = describe_place(torch.where(known, grey, noise), CAMERA, known)
    torch.testing.assert_close(first, describe_place(torch.where(known, grey, torch.nan), CAMERA))
    assert similarity(first, describe_place(grey, CAMERA))[0] > 0.85


def test_a_pinhole_knows_its_view_again_and_no_other(room):
    camera = Pinhole(320, 240, 160.0, 160.0, 160.0, 120.0)
    ahead, _ = room.look(room.pose(), camera)
    nearly, _ = room.look(room.pose((0.05, 0.05, 0.0), yaw=0.02), camera)
    aside, _ = room.look(room.pose(yaw=2.0), camera)
    place = describe_place(ahead, camera)
    assert place.shape == (DESCRIPTOR_SIZE,)
    assert similarity(describe_place(nearly, camera), place, wraps=False)[0] > 0.6
    assert similarity(describe_place(aside, camera), place, wraps=False)[0] < 0.4
    assert similarity(describe_place(ahead * 2 + 0.1, camera), place, wraps=False)[0] > 0.999


# The index


def random_descriptors(count: int) -> torch.Tensor:
    d = torch.randn(count, DESCRIPTOR_SIZE, generator=torch.Generator().manual_seed(0))
    return d / d.norm(dim=-1, keepdim=True)


def filled(count: int) -> tuple[PlaceIndex, torch.Tensor]:
    index, descriptors = PlaceIndex(CAMERA), random_descriptors(count)
    for k, descriptor in enumerate(descriptors):
        index.add(10 * k, descriptor)
    return index, descriptors


def test_the_index_finds_each_of_many_first():
    index, descriptors = filled(200)
    assert len(index) == 200
    for k in (0, 63, 64, 199):
        best = index.query(descriptors[k], count=1)[0]
        assert best.key_id == 10 * k
        assert best.similarity > MIN_SIMILARITY


def test_excluded_and_newest_keyframes_are_no_candidates():
    index, descriptors = filled(50)
    assert (
        index.query(descriptors[40], exclude=[400]) == []
        or index.query(descriptors[40], exclude=[400])[0].key_id != 400
    )
    assert all(c.key_id < 400 for c in index.query(descriptors[40], skip_newest=10, min_similarity=-1.0))


def test_candidates_are_the_best_first_and_no_neighbours():
    index, base = PlaceIndex(CAMERA), random_descriptors(3)
    for k in range(30):
        index.add(k, base[k // 10])
    found = index.query(base[1] + 0.8 * base[0], min_similarity=-1.0, apart=9)
    assert [c.key_id // 10 for c in found][:2] == [1, 0]
    assert all(a.similarity >= b.similarity for a, b in itertools.pairwise(found))
    ids = [c.key_id for c in found]
    assert all(abs(a - b) > 9 for k, a in enumerate(ids) for b in ids[:k])


def test_an_empty_index_answers_with_nothing_and_forgets_what_it_is_told_to():
    index = PlaceIndex(CAMERA)
    descriptor = random_descriptors(1)[0]
    assert index.query(descriptor) == []
    index.add(3, descriptor)
    with pytest.raises(InputError, match="key_id"):
        index.add(3, descriptor)
    index.forget(0)
    assert index.query(descriptor, min_similarity=-1.0) == []
    index.add(3, descriptor)
    assert len(index) == 1


def test_what_is_no_descriptor_is_refused():
    with pytest.raises(ShapeError, match="descriptor"):
        PlaceIndex(CAMERA).add(0, torch.zeros(3))
    with pytest.raises(ShapeError, match="image"):
        describe_place(torch.zeros(10, 20), CAMERA)


def test_what_is_kept_is_found_and_the_rest_is_forgotten():
    index, descriptors = filled(100)
    index.keep([10 * k for k in range(0, 100, 7)])
    assert len(index) == 15
    assert index.query(descriptors[7])[0].key_id == 70
    assert index.query(descriptors[8]) == []
    index.add(80, descriptors[8])
    assert index.query(descriptors[8])[0].key_id == 80
