import numpy as np
import pytest

from torchvo360.viz.plan import MOST_POINTS, level_with_path

PATH = np.array([[0.0, 0, 0], [1, 0, 0]])


def test_a_large_map_is_thinned_evenly_and_upper_points_come_last():
    count = 4 * MOST_POINTS
    generator = np.random.default_rng(0)
    xyz = generator.uniform([-3, -3, -0.1], [3, 3, 0.1], (count, 3))
    height_as_grey = np.repeat(((xyz[:, 2:] + 0.1) * 1275).astype(np.uint8), 3, 1)
    plan = level_with_path(xyz, height_as_grey, PATH)
    assert plan is not None
    assert 0.7 * MOST_POINTS < len(plan.xy) <= MOST_POINTS
    np.testing.assert_allclose(
        np.quantile(plan.xy, [0.25, 0.5, 0.75], axis=0), [[-1.5] * 2, [0] * 2, [1.5] * 2], atol=0.1
    )
    assert (np.diff(plan.rgb[:, 0]) >= 0).all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_choice_does_not_depend_on_the_unit(scale):
    generator = np.random.default_rng(1)
    xyz = generator.normal(size=(500, 3))
    index_as_colour = np.arange(500)[:, None].repeat(3, 1)
    plans = [level_with_path(factor * xyz, index_as_colour, factor * PATH) for factor in (1.0, scale)]
    assert plans[0] is not None
    assert plans[1] is not None
    assert 50 < len(plans[0].xy) < 450
    np.testing.assert_array_equal(plans[0].rgb, plans[1].rgb)
    np.testing.assert_allclose(scale * plans[0].box, plans[1].box)


def test_the_band_of_heights_follows_a_path_that_climbs():
    along = np.linspace(0, 50, 200)
    path = np.stack([along, 0 * along, along], -1)
    beside, overhead = (path + np.array(shift) for shift in ([0, 2, 0], [-5, 0, 5]))
    plan = level_with_path(np.concatenate([beside, overhead]), np.zeros((400, 3)), path)
    assert plan is not None
    np.testing.assert_allclose(plan.xy, beside[:, :2])


def test_a_map_that_is_nowhere_level_with_the_path_has_no_plan():
    assert level_with_path(np.array([[0.0, 0, 5], [1, 0, 5]]), np.zeros((2, 3)), PATH) is None
    assert level_with_path(np.zeros((0, 3)), np.zeros((0, 3)), PATH) is None
