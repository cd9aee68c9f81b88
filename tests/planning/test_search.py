"""A* against Dijkstra, on both backends, and where it is easily wrong."""

import itertools
import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from torchvo360.checks import InputError
from torchvo360.planning import find_path
from torchvo360.planning.astar import octile
from torchvo360.planning.search import NUMBA_FROM, has_numba

BACKENDS = ["python", pytest.param("numba", marks=pytest.mark.skipif(not has_numba(), reason="numba is missing"))]

SIDES = [(0, 1), (1, 0), (1, 1), (1, -1)]


def least_costs(weight, start):
    """Costs of all cells by scipy's Dijkstra on a graph of all permitted steps."""
    rows, columns = weight.shape
    number = np.arange(weight.size).reshape(weight.shape)
    tails, heads, costs = [], [], []
    for row, column in itertools.product(range(rows), range(columns)):
        for down, right in SIDES:
            r, c = row + down, column + right
            if not (0 <= r < rows and 0 <= c < columns):
                continue
            cells = [weight[row, column], weight[r, c]]
            beside = [weight[row, c], weight[r, column]] if down and right else []
            if np.isfinite([*cells, *beside]).all():
                tails.append(number[row, column])
                heads.append(number[r, c])
                costs.append(math.hypot(down, right) * (cells[0] + cells[1]) / 2)
    graph = coo_matrix((costs, (tails, heads)), (weight.size, weight.size))
    return dijkstra(graph, directed=False, indices=number[start]).reshape(weight.shape)


def cost_of(cells, weight):
    steps = np.hypot(*np.diff(cells, axis=0).T)
    along = weight[tuple(cells.T)]
    return float((steps * (along[:-1] + along[1:]) / 2).sum())


@st.composite
def problems(draw):
    rows, columns = draw(st.integers(1, 14)), draw(st.integers(1, 14))
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    weight = 1 + draw(st.sampled_from([0.0, 3.0])) * generator.random((rows, columns))
    weight[generator.random((rows, columns)) < draw(st.sampled_from([0.0, 0.25, 0.4]))] = np.inf
    ends = [(int(generator.integers(rows)), int(generator.integers(columns))) for _ in range(2)]
    for end in ends:
        weight[end] = 1.0
    return weight, ends[0], ends[1]


@pytest.mark.parametrize("backend", BACKENDS)
@given(problems())
@settings(max_examples=150, deadline=None)
def test_the_way_is_as_cheap_as_dijkstras(backend, problem):
    weight, start, goal = problem
    found = find_path(weight, start, goal, backend=backend)
    truth = least_costs(weight, start)[goal]
    assert found.cost == pytest.approx(truth, abs=1e-6)
    assert found.reopened == 0  # the octile distance is consistent
    if math.isinf(truth):
        assert found.cells is None
        return
    assert found.cells is not None
    assert tuple(found.cells[0]) == start
    assert tuple(found.cells[-1]) == goal
    assert cost_of(found.cells, weight) == pytest.approx(truth, abs=1e-6)
    for (row, column), (r, c) in itertools.pairwise(found.cells):
        assert max(abs(r - row), abs(c - column)) == 1
        assert np.isfinite([weight[r, c], weight[row, c], weight[r, column]]).all()  # no corner is cut


@pytest.mark.parametrize("backend", BACKENDS)
@given(problems(), st.integers(0, 2**32 - 1))
@settings(max_examples=100, deadline=None)
def test_with_inconsistent_bounds_it_is_still_dijkstras(backend, problem, seed):
    weight, start, goal = problem
    to_goal = least_costs(weight, goal)
    share = np.random.default_rng(seed).integers(0, 2, weight.shape)  # all or nothing of what lies ahead
    bound = np.where(np.isfinite(to_goal), to_goal, 0.0) * share * 0.999
    found = find_path(weight, start, goal, bound=bound, backend=backend)
    assert found.cost == pytest.approx(to_goal[start], abs=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_cheaper_way_to_a_closed_cell_opens_it_again(backend):
    weight = np.full((3, 12), np.inf)
    weight[1, 0] = weight[1, 3:] = 1.0
    weight[0, :4], weight[2, :4] = 1.0, 1.3  # two ways to a corridor
    bound = np.zeros((3, 12))
    bound[0, 1:4] = least_costs(weight, (1, 11))[0, 1:4]  # the cheap one looks dear until the corridor is searched
    found = find_path(weight, (1, 0), (1, 11), bound=bound, backend=backend)
    assert found.cost == pytest.approx(least_costs(weight, (1, 0))[1, 11])
    assert found.reopened >= 5


@pytest.mark.skipif(not has_numba(), reason="numba is missing")
@given(problems())
@settings(max_examples=100, deadline=None)
def test_both_backends_find_the_same_way(problem):
    weight, start, goal = problem
    slow, fast = (find_path(weight.astype(np.float32), start, goal, backend=name) for name in ("python", "numba"))
    assert (slow.cost, slow.searched, slow.nearest) == (fast.cost, fast.searched, fast.nearest)
    np.testing.assert_array_equal(slow.cells, fast.cells)


def test_the_octile_distance_is_the_cost_where_nothing_is_in_the_way():
    costs = least_costs(np.ones((9, 13)), (4, 5))
    octiles = [[octile(row - 4, column - 5) for column in range(13)] for row in range(9)]
    np.testing.assert_allclose(octiles, costs, atol=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_start_may_be_the_goal(backend):
    found = find_path(np.ones((3, 3)), (1, 2), (1, 2), backend=backend)
    assert found.cells is not None
    assert found.cells.tolist() == [[1, 2]]
    assert found.cost == 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", [(1, 9), (9, 1)])
def test_a_grid_may_be_one_cell_wide(backend, shape):
    end = (shape[0] - 1, shape[1] - 1)
    assert find_path(np.ones(shape), (0, 0), end, backend=backend).cost == 8
    blocked = np.ones(shape)
    blocked.flat[5] = np.inf
    found = find_path(blocked, (0, 0), end, backend=backend)
    assert found.cells is None
    assert found.searched == 5
    assert sum(found.nearest) == 4


def test_a_dead_end_is_not_the_end():
    weight = np.ones((9, 9))
    weight[2:7, 6] = weight[2, 2:7] = weight[6, 2:7] = np.inf  # a cup that opens away from the goal
    found = find_path(weight, (4, 4), (4, 8), backend="python")
    assert found.cost == pytest.approx(least_costs(weight, (4, 4))[4, 8])


def test_between_two_corners_that_touch_there_is_no_way():
    weight = np.array([[1.0, np.inf], [np.inf, 1.0]])
    assert find_path(weight, (0, 0), (1, 1), backend="python").cells is None


def test_small_grids_do_not_wait_for_numba(monkeypatch):
    def refused(*_):
        raise AssertionError("numba was asked for")

    monkeypatch.setattr("torchvo360.planning.search._compiled", refused)
    assert find_path(np.ones((20, 20)), (0, 0), (19, 19)).cost == pytest.approx(19 * 2**0.5)
    with pytest.raises(AssertionError):
        find_path(np.ones((1, NUMBA_FROM)), (0, 0), (0, 1), backend="numba")


def test_without_numba_python_does_it_and_numba_is_refused(monkeypatch):
    monkeypatch.setattr("torchvo360.planning.search.has_numba", lambda: False)
    assert find_path(np.ones((1, NUMBA_FROM)), (0, 0), (0, 2)).cost == 2
    with pytest.raises(InputError, match=r"^backend: expected numba .*torchvo360\[fast\]"):
        find_path(np.ones((3, 3)), (0, 0), (1, 1), backend="numba")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"weight": np.full((3, 3), 0.5)}, "weight"),
        ({"weight": np.full((3, 3), np.nan)}, "weight"),
        ({"weight": np.ones(3)}, "weight"),
        ({"weight": np.ones((3, 3), int)}, "weight"),
        ({"start": (3, 0)}, "start"),
        ({"start": (0, -1)}, "start"),
        ({"goal": (1, 1)}, "goal"),
        ({"bound": np.ones((2, 2))}, "bound"),
        ({"bound": np.full((3, 3), -1.0)}, "bound"),
        ({"bound": np.full((3, 3), np.nan)}, "bound"),
        ({"backend": "gpu"}, "backend"),
    ],
)
def test_what_cannot_be_searched_is_refused(arguments, told):
    weight = np.ones((3, 3))
    weight[1, 1] = np.inf
    with pytest.raises(InputError, match=f"^{told}: expected"):
        find_path(**{"weight": weight, "start": (0, 0), "goal": (2, 2), **arguments})


@pytest.mark.slow
@pytest.mark.skipif(not has_numba(), reason="numba is missing")
def test_four_million_cells_are_searched_in_time():
    """0.2 s on one core; the bound allows for a busy machine."""
    generator = np.random.default_rng(0)
    weight = np.ones((2000, 2000), np.float32)
    places, sizes = generator.integers(10, 1900, (400, 2)), generator.integers(10, 80, (400, 2))
    for (row, column), (height, width) in zip(places, sizes, strict=True):
        weight[row : row + height, column : column + width] = np.inf
    weight[:50, :50] = weight[-50:, -50:] = 1
    find_path(weight, (0, 0), (10, 10), backend="numba")
    seconds = []
    for _ in range(3):
        begin = time.perf_counter()
        assert find_path(weight, (20, 20), (1970, 1950), backend="numba").cells is not None
        seconds.append(time.perf_counter() - begin)
    assert min(seconds) < 1.0
