"""What is fast stays fast, held by ratios: `pytest tests/benchmarks/bench_ratios.py`, outside of the plain test run.

The baseline is committed; `python benchmarks/ratios.py --write` measures it anew.
"""

import json

import pytest
import torch

from ratios import BASELINE, cases, grown_mb, peak_images, ratio_of

pytest.importorskip("pytest_benchmark")

WORSE = 1.8
"""A ratio may be this many times its baseline: caches and other programs change it by a third."""
LEAST = json.loads(BASELINE.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", LEAST)
def test_a_ratio_is_no_worse_than_its_baseline(name, benchmark):
    call = cases().get(name)
    if call is None:
        pytest.skip("numba is not installed")
    ratio = ratio_of(name)
    benchmark.extra_info["ratio"] = ratio
    with torch.no_grad():
        benchmark.pedantic(call[0], rounds=5)
    assert ratio < WORSE * LEAST[name]


def test_the_eager_kernel_takes_a_few_images_of_memory():
    assert peak_images() < 15


def test_memory_does_not_grow_with_the_calls():
    assert grown_mb() < 20
