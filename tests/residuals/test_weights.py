"""A robust weight is its cost's slope over the residual; the weight by depth is LSD-SLAM's, with its own slope."""

import math

import pytest
import torch

from torchvo360.checks import InputError
from torchvo360.residuals.weights import LossConfig, depth_variance_weight, robust

LOSSES = pytest.mark.parametrize(
    "loss",
    [
        LossConfig(),
        LossConfig(scale=0.3),
        LossConfig(name="student_t", scale=0.05),
        LossConfig(name="student_t", scale=0.02, degrees_of_freedom=2.0),
        LossConfig(name="none"),
        LossConfig(cutoff=0.2),
        LossConfig(name="student_t", scale=0.05, cutoff=0.2),
        LossConfig(name="none", cutoff=0.2),
    ],
    ids=lambda loss: f"{loss.name} {loss.scale:.2g} {loss.cutoff}",
)


def residuals(dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.cat(
        [torch.linspace(-1, 1, 401, dtype=dtype) + 1e-4, torch.tensor([1e-9, -1e-9, 5.0, -80.0], dtype=dtype)]
    )


@LOSSES
def test_the_weight_is_the_slope_of_the_cost_over_the_residual(loss):
    r = residuals().requires_grad_()
    weight, cost = robust(r, loss)
    (slope,) = torch.autograd.grad(cost.sum(), r)
    torch.testing.assert_close(weight * r, slope, atol=1e-12, rtol=1e-12)
    # An independent derivative: central differences, away from the cut-off's kink.
    step = 1e-6
    numeric = (robust(r + step, loss)[1] - robust(r - step, loss)[1]) / (2 * step)
    away = (r.abs() - (loss.cutoff or 1e9)).abs() > 2 * step
    torch.testing.assert_close((weight * r)[away], numeric[away], atol=1e-6, rtol=1e-6)


@LOSSES
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)], ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_losses_are_even_rise_and_start_as_squares(loss, batch, dtype):
    r = torch.rand(batch, generator=torch.Generator().manual_seed(0)).to(dtype)
    weight, cost = robust(r, loss)
    mirrored_weight, mirrored_cost = robust(-r, loss)
    assert weight.shape == cost.shape == batch
    assert weight.dtype == cost.dtype == dtype
    assert torch.equal(weight, mirrored_weight)
    assert torch.equal(cost, mirrored_cost)
    rising = robust(torch.linspace(0, 3, 500, dtype=dtype), loss)[1]
    assert (rising.diff() >= 0).all()
    near = torch.tensor(1e-4, dtype=dtype)
    at_zero = (loss.degrees_of_freedom + 1) / loss.degrees_of_freedom if loss.name == "student_t" else 1.0
    torch.testing.assert_close(robust(near, loss)[0], torch.tensor(at_zero, dtype=dtype), rtol=1e-4, atol=0)
    torch.testing.assert_close(robust(near, loss)[1], near**2 / 2 * at_zero, rtol=1e-3, atol=0)


@LOSSES
def test_costs_are_continuous(loss):
    for at in (loss.scale, loss.cutoff or loss.scale):
        below, above = robust(torch.tensor([at - 1e-9, at + 1e-9], dtype=torch.float64), loss)[1]
        assert abs(above - below) < 1e-8


@pytest.mark.parametrize("name", ["huber", "student_t", "none"])
def test_beyond_the_cutoff_nothing_weighs_and_the_cost_is_constant(name):
    loss = LossConfig(name=name, scale=0.05, cutoff=0.2)
    open_loss = LossConfig(name=name, scale=0.05)
    weight, cost = robust(torch.tensor([0.1, 0.2, 0.21, 4.0], dtype=torch.float64), loss)
    expected = robust(torch.tensor([0.1, 0.2], dtype=torch.float64), open_loss)
    torch.testing.assert_close(weight[:2], expected[0])
    torch.testing.assert_close(cost[:2], expected[1])
    assert weight[2:].tolist() == [0, 0]
    torch.testing.assert_close(cost[2:], cost[1].expand(2))


def test_values_of_the_papers_formulas():
    weight, cost = robust(torch.tensor([0.02, 0.5], dtype=torch.float64), LossConfig(scale=0.1))
    torch.testing.assert_close(weight, torch.tensor([1.0, 0.2], dtype=torch.float64))
    torch.testing.assert_close(cost, torch.tensor([0.0002, 0.1 * (0.5 - 0.05)], dtype=torch.float64))
    weight, cost = robust(torch.tensor([0.1], dtype=torch.float64), LossConfig(name="student_t", scale=0.1))
    torch.testing.assert_close(weight, torch.tensor([6 / 6], dtype=torch.float64))
    torch.testing.assert_close(cost, torch.tensor([3 * 0.01 * math.log(1.2)], dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(
    "loss", [LossConfig(), LossConfig(name="student_t"), LossConfig(name="none")], ids=lambda x: x.name
)
def test_gradients_are_finite_at_zero(loss, dtype):
    r = torch.tensor([0.0, 1e-30, -1e-30], dtype=dtype, requires_grad=True)
    weight, cost = robust(r, loss)
    (gradient,) = torch.autograd.grad((weight + cost).sum(), r)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)], ids=str)
def test_the_weight_by_depth_and_its_slope(batch):
    generator = torch.Generator().manual_seed(0)
    slope_of_image = torch.randn(batch, generator=generator, dtype=torch.float64).requires_grad_()
    variance, noise = torch.rand(batch, generator=generator, dtype=torch.float64), 0.03
    weight, slope = depth_variance_weight(slope_of_image, variance, noise)
    # mathematics.md, section 5, relative to exact depth.
    lsd = 1 / (2 * noise**2 + slope_of_image**2 * variance)
    torch.testing.assert_close(weight, lsd / (1 / (2 * noise**2)))
    (derivative,) = torch.autograd.grad((0.5 * weight.log()).sum(), slope_of_image)
    torch.testing.assert_close(slope, -derivative)


def test_exact_depth_and_no_parallax_weigh_fully():
    zero, one = torch.zeros(3), torch.ones(3)
    for dI_drho, variance in ((one, zero), (zero, one), (zero, zero)):
        weight, slope = depth_variance_weight(dI_drho, variance, 0.01)
        assert torch.equal(weight, one)
        assert torch.equal(slope, zero)


def test_bad_settings_are_named():
    with pytest.raises(InputError, match=r"^loss.name: expected one of huber, student_t, none, got 'cauchy'\.$"):
        LossConfig(name="cauchy")
    with pytest.raises(InputError, match=r"^loss.scale: expected a finite number above 0, got 0\.$"):
        LossConfig(scale=0)
    with pytest.raises(InputError, match=r"^loss.cutoff: expected a finite number above 0, got -1\.$"):
        LossConfig(cutoff=-1)
    with pytest.raises(InputError, match=r"^loss.degrees_of_freedom: "):
        LossConfig(degrees_of_freedom=float("nan"))
