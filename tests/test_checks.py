"""Every refusal is one sentence that names the argument, what was expected and what came."""

import math

import numpy as np
import pytest
import torch

from torchvo360 import checks, lie
from torchvo360.checks import InputError, ShapeError


class TestShape:
    def test_named_sizes_come_back(self):
        assert checks.check_shape("image", torch.zeros(2, 3, 4, 5), "... C H W") == {"C": 3, "H": 4, "W": 5}

    @pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
    def test_any_batch_fits_the_ellipsis(self, batch: tuple[int, ...]):
        checks.check_shape("p_cam", torch.zeros(*batch, 3), "... 3")

    @pytest.mark.parametrize(
        ("shape", "pattern"),
        [((2, 4), "... 3"), ((), "... 3"), ((3,), "... 4 4"), ((2, 3), "3"), ((3, 4), "N N"), ((2, 3, 4), "... N N")],
    )
    def test_a_misfit_is_named_with_both_shapes(self, shape: tuple[int, ...], pattern: str):
        with pytest.raises(ShapeError) as refusal:
            checks.check_shape("p_cam", torch.zeros(shape), pattern)
        assert str(refusal.value) == f"p_cam: expected shape [{pattern}], got {list(shape)}."

    def test_a_name_used_twice_has_one_size(self):
        assert checks.check_shape("H", torch.zeros(7, 8, 8), "... D D") == {"D": 8}

    def test_what_is_no_tensor_is_refused(self):
        with pytest.raises(InputError, match=r"^image: expected a tensor, got ndarray\.$"):
            checks.check_shape("image", np.zeros((4, 3)), "... 3")  # pyright: ignore[reportArgumentType]


class TestNumbersAndWords:
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 0.0, -1.0, 2.5, "1", None])
    def test_numbers_outside_the_interval_are_refused(self, value: float):
        with pytest.raises(InputError, match=r"^scale: expected a finite number above 0 at most 2, got .*\.$"):
            checks.check_finite_number("scale", value, above=0, at_most=2)

    @pytest.mark.parametrize("value", [1e-300, 1, 2.0, np.float32(1.5)])
    def test_numbers_inside_the_interval_pass(self, value: float):
        checks.check_finite_number("scale", value, above=0, at_most=2)

    def test_a_word_outside_the_choices_is_refused_with_the_choices(self):
        checks.check_choice("camera.fit", "crop", ["none", "stretch", "crop"])
        with pytest.raises(InputError, match=r"^camera\.fit: expected one of none, stretch, crop, got 'squash'\.$"):
            checks.check_choice("camera.fit", "squash", ["none", "stretch", "crop"])


class TestTensors:
    @pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.bool, torch.complex64])
    def test_only_floating_types_pass(self, dtype: torch.dtype):
        checks.check_floating("image", torch.zeros(1))
        with pytest.raises(InputError, match=rf"^image: expected a floating-point tensor, got {dtype}\.$"):
            checks.check_floating("image", torch.zeros(1, dtype=dtype))

    def test_tensors_on_two_devices_are_refused_with_each_ones_device(self):
        cpu, meta = torch.zeros(1), torch.zeros(1, device="meta")
        checks.check_same_device(ref=cpu, tgt=cpu, mask=None)
        with pytest.raises(
            InputError, match=r"^device: expected all tensors on one device, got ref on cpu, tgt on meta\.$"
        ):
            checks.check_same_device(ref=cpu, tgt=meta, mask=None)


class TestPose:
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
    def test_rigid_motions_pass(self, batch: tuple[int, ...], dtype: torch.dtype):
        xi = torch.randn(*batch, 6, generator=torch.Generator().manual_seed(0), dtype=dtype)
        checks.check_pose("T_tgt_ref", lie.se3_exp(xi))

    @pytest.mark.parametrize(
        "spoilt",
        [
            pytest.param(torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0])), id="scaled"),
            pytest.param(torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0])), id="mirrored"),
            pytest.param(torch.diag(torch.tensor([1.0, 1.0, 1.0, 2.0])), id="last row"),
            pytest.param(torch.full((4, 4), math.nan), id="nan"),
            pytest.param(torch.eye(4) + torch.diag(torch.full((3,), math.inf), 1), id="inf"),
            pytest.param(torch.zeros(4, 4), id="zeros"),
        ],
    )
    def test_another_matrix_is_refused_alone_and_inside_a_batch(self, spoilt: torch.Tensor):
        with pytest.raises(InputError, match=r"^T_tgt_ref: expected rigid motions"):
            checks.check_pose("T_tgt_ref", spoilt)
        with pytest.raises(InputError, match=r"^T_tgt_ref: expected rigid motions"):
            checks.check_pose("T_tgt_ref", torch.stack([torch.eye(4), spoilt]))

    def test_integers_and_other_shapes_are_refused(self):
        with pytest.raises(InputError, match=r"^T_tgt_ref: expected a floating-point tensor"):
            checks.check_pose("T_tgt_ref", torch.eye(4, dtype=torch.int64))
        with pytest.raises(ShapeError, match=r"^T_tgt_ref: expected shape"):
            checks.check_pose("T_tgt_ref", torch.eye(3))
