"""Group axioms, closed forms against independent oracles, derivatives, and the hard points: identity and near pi."""

import math
from collections.abc import Callable

import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jacfwd

from torchvo360 import lie
from torchvo360.checks import ShapeError

BATCHES = [(), (5,), (2, 3)]
DTYPES = [torch.float32, torch.float64]
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-12}

SMALL_ANGLES = [0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 9.99e-3, 1.001e-2]
"""Down to the identity, and either side of the angle where the series take over."""

ANGLES_NEAR_PI = [math.pi - delta for delta in (1e-2, 1e-4, 1e-6, 1e-9, 1e-12)]

AXES = [
    (1.0, 0.0, 0.0),
    (0.0, 1.0, 0.0),
    (0.0, 0.0, 1.0),
    (0.0, -1.0, 0.0),
    (0.6, -0.8, 0.0),
    (-0.36, 0.48, 0.8),
    (-0.6, -0.64, -0.48),
]


def random_rotation_vectors(batch: tuple[int, ...], dtype: torch.dtype, seed: int = 0) -> Float[Tensor, "*batch 3"]:
    generator = torch.Generator().manual_seed(seed)
    axis = torch.nn.functional.normalize(torch.randn(*batch, 3, generator=generator, dtype=torch.float64), dim=-1)
    return (axis * 3 * torch.rand(*batch, 1, generator=generator, dtype=torch.float64)).to(dtype)


def random_tangents(
    batch: tuple[int, ...], dtype: torch.dtype, size: int = 6, seed: int = 0
) -> Float[Tensor, "*batch D"]:
    """Random [v, w] or [v, w, s], the angle below 3 rad."""
    generator = torch.Generator().manual_seed(100 + seed)
    v = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    s = 0.4 * torch.randn(*batch, size - 6, generator=generator, dtype=torch.float64)
    return torch.cat([v.to(dtype), random_rotation_vectors(batch, dtype, seed), s.to(dtype)], -1)


def se3_hat(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """The generator of SE(3), written out apart from the code under test."""
    hat = torch.zeros(*xi.shape[:-1], 4, 4, dtype=xi.dtype)
    hat[..., :3, 3] = xi[..., :3]
    hat[..., 2, 1], hat[..., 0, 2], hat[..., 1, 0] = xi[..., 3], xi[..., 4], xi[..., 5]
    hat[..., 1, 2], hat[..., 2, 0], hat[..., 0, 1] = -xi[..., 3], -xi[..., 4], -xi[..., 5]
    return hat


def so3_reference(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    return torch.linalg.matrix_exp(se3_hat(torch.cat([torch.zeros_like(w), w], -1))[..., :3, :3])


def close(actual: Tensor, expected: Tensor, atol: float) -> None:
    torch.testing.assert_close(actual, expected, atol=atol, rtol=0)


Exp = Callable[[Tensor], Tensor]
GROUPS = [
    pytest.param(lie.se3_exp, lie.se3_log, lie.se3_inverse, lie.se3_adjoint, 6, id="se3"),
    pytest.param(lie.sim3_exp, lie.sim3_log, lie.sim3_inverse, lie.sim3_adjoint, 7, id="sim3"),
]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
class TestGroupAxioms:
    @pytest.mark.parametrize(("exp", "log", "inverse", "adjoint", "size"), GROUPS)
    def test_inverse_identity_and_closure(
        self, exp: Exp, log: Exp, inverse: Exp, adjoint: Exp, size: int, batch: tuple[int, ...], dtype: torch.dtype
    ):
        A, B = (exp(random_tangents(batch, dtype, size, seed)) for seed in (1, 2))
        eye = torch.eye(4, dtype=dtype).expand(*batch, 4, 4)
        atol = 10 * TOLERANCE[dtype]
        close(A @ inverse(A), eye, atol)
        close(inverse(A) @ A, eye, atol)
        close(inverse(A @ B), inverse(B) @ inverse(A), atol)
        close(exp(log(A @ B)), A @ B, atol)
        close(exp(torch.zeros(*batch, size, dtype=dtype)), eye, 0)
        assert A.dtype == log(A).dtype == adjoint(A).dtype == dtype
        assert log(A).shape == (*batch, size)

    @pytest.mark.parametrize(("exp", "log", "inverse", "adjoint", "size"), GROUPS)
    def test_the_log_undoes_the_exp_below_pi(
        self, exp: Exp, log: Exp, inverse: Exp, adjoint: Exp, size: int, batch: tuple[int, ...], dtype: torch.dtype
    ):
        xi = random_tangents(batch, dtype, size, 3)
        close(log(exp(xi)), xi, 20 * TOLERANCE[dtype])
        close(exp(-xi), inverse(exp(xi)), 10 * TOLERANCE[dtype])

    @pytest.mark.parametrize(("exp", "log", "inverse", "adjoint", "size"), GROUPS)
    def test_the_adjoint_carries_a_tangent_across_an_element(
        self, exp: Exp, log: Exp, inverse: Exp, adjoint: Exp, size: int, batch: tuple[int, ...], dtype: torch.dtype
    ):
        A, B = (exp(random_tangents(batch, dtype, size, seed)) for seed in (4, 5))
        xi = 0.3 * random_tangents(batch, dtype, size, 6)
        carried = (adjoint(A) @ xi[..., None])[..., 0]
        close(A @ exp(xi) @ inverse(A), exp(carried), 100 * TOLERANCE[dtype])
        close(adjoint(A @ B), adjoint(A) @ adjoint(B), 100 * TOLERANCE[dtype])

    def test_rotations_stay_orthonormal_with_determinant_one(self, batch: tuple[int, ...], dtype: torch.dtype):
        R = lie.so3_exp(4 * random_rotation_vectors(batch, dtype, 7))
        close(R @ R.mT, torch.eye(3, dtype=dtype).expand(*batch, 3, 3), TOLERANCE[dtype])
        close(torch.linalg.det(R), torch.ones(batch, dtype=dtype), TOLERANCE[dtype])

    def test_the_hat_is_the_cross_product(self, batch: tuple[int, ...], dtype: torch.dtype):
        w, p = random_rotation_vectors(batch, dtype, 8), random_rotation_vectors(batch, dtype, 9)
        close((lie.so3_hat(w) @ p[..., None])[..., 0], torch.linalg.cross(w, p), TOLERANCE[dtype])

    def test_se3_puts_rotation_and_translation_in_their_places(self, batch: tuple[int, ...], dtype: torch.dtype):
        R, t = lie.so3_exp(random_rotation_vectors(batch, dtype, 10)), random_rotation_vectors(batch, dtype, 11)
        p = random_rotation_vectors(batch, dtype, 12)
        moved = lie.se3(R, t) @ torch.cat([p, torch.ones_like(p[..., :1])], -1)[..., None]
        close(moved[..., :3, 0], (R @ p[..., None])[..., 0] + t, TOLERANCE[dtype])
        close(moved[..., 3, 0], torch.ones(batch, dtype=dtype), 0)


class TestClosedForms:
    @pytest.mark.parametrize("angle", [*SMALL_ANGLES, 0.5, 2.0, *ANGLES_NEAR_PI, math.pi, 4.0, 6.2])
    def test_exponentials_equal_the_matrix_exponential(self, angle: float):
        w = angle * torch.tensor(AXES, dtype=torch.float64)
        v = torch.tensor([0.3, -2.0, 1.1], dtype=torch.float64).expand_as(w)
        xi = torch.cat([v, w], -1)
        close(lie.so3_exp(w), so3_reference(w), 1e-14)
        close(lie.se3_exp(xi), torch.linalg.matrix_exp(se3_hat(xi)), 1e-13)

    @pytest.mark.parametrize("angle", [*SMALL_ANGLES, 0.5, 2.0, math.pi])
    def test_single_precision_is_as_good_as_its_numbers(self, angle: float):
        w = angle * torch.tensor(AXES, dtype=torch.float64)
        xi = torch.cat([torch.tensor([0.3, -2.0, 1.1], dtype=torch.float64).expand_as(w), w], -1)
        close(lie.se3_exp(xi.float()).double(), lie.se3_exp(xi), 1.5e-6)
        close(lie.so3_left_jacobian(w.float()).double(), lie.so3_left_jacobian(w), 5e-7)

    def test_similarities_equal_the_matrix_exponential_of_a_scaled_generator(self):
        xi = random_tangents((20,), torch.float64, 7)
        generator = se3_hat(xi[..., :6])
        generator[..., :3, :3] += xi[..., 6, None, None] * torch.eye(3, dtype=torch.float64)
        close(lie.sim3_hat(xi), generator, 0)
        close(lie.sim3_exp(xi), torch.linalg.matrix_exp(generator), 1e-12)

    @pytest.mark.parametrize("log_scale", [0.0, 1e-12, -1e-6, 1e-3, -2.0, 3.0])
    @pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, math.pi - 1e-6])
    def test_similarity_round_trips_at_small_and_large_scale_and_angle(self, log_scale: float, angle: float):
        w = angle * torch.tensor(AXES, dtype=torch.float64)
        xi = torch.cat([w.new_tensor([0.3, -2.0, 1.1]).expand_as(w), w, torch.full_like(w[..., :1], log_scale)], -1)
        S = lie.sim3_exp(xi)
        close(lie.sim3_log(S), xi, 1e-8 if angle > 3 else 1e-11)
        close(S @ lie.sim3_inverse(S), torch.eye(4, dtype=torch.float64).expand_as(S), 1e-12)

    def test_a_similarity_of_scale_one_is_a_rigid_motion(self):
        xi = random_tangents((10,), torch.float64)
        S = lie.sim3_exp(torch.cat([xi, torch.zeros(10, 1, dtype=torch.float64)], -1))
        close(S, lie.se3_exp(xi), 1e-12)
        close(lie.sim3_log(S)[..., :6], lie.se3_log(S), 1e-11)
        close(lie.sim3_adjoint(S)[..., :6, :6], lie.se3_adjoint(S), 1e-12)

    @pytest.mark.parametrize("angle", [*SMALL_ANGLES, 0.5, 2.0, 3.1, 5.0])
    def test_the_left_jacobian_is_the_derivative_of_the_exponential(self, angle: float):
        for axis in AXES:
            w = angle * torch.tensor(axis, dtype=torch.float64)
            # d exp(w + d) exp(w)^-1 / dd is a hat: its vee is the left Jacobian's column.
            dR = jacfwd(so3_reference)(w)
            spin = torch.einsum("ijk,lj->ilk", dR, so3_reference(w))
            vee = torch.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
            close(lie.so3_left_jacobian(w), vee, 1e-12)

    def test_logarithms_and_exponentials_agree_with_pypose(self):
        pypose = pytest.importorskip("pypose")
        xi = random_tangents((3, 7), torch.float64)
        T = pypose.se3(xi).Exp()
        close(lie.se3_exp(xi), T.matrix(), 1e-12)
        close(lie.se3_log(lie.se3_exp(xi)), T.Log().tensor(), 1e-11)
        # pypose offers the product of the adjoint with a tangent only: column by column.
        columns = [T.Adj(pypose.se3(e.expand(3, 7, 6))).tensor() for e in torch.eye(6, dtype=torch.float64)]
        close(lie.se3_adjoint(lie.se3_exp(xi)), torch.stack(columns, -1), 1e-12)
        close(lie.matrix_from_quaternion(T.tensor()[..., 3:]), T.rotation().matrix(), 1e-12)

    def test_similarities_agree_with_pypose(self):
        pypose = pytest.importorskip("pypose")
        xi = random_tangents((9,), torch.float64, 7)
        S = pypose.sim3(xi).Exp()
        close(lie.sim3_exp(xi), S.matrix(), 1e-9)
        close(lie.sim3_log(lie.sim3_exp(xi)), S.Log().tensor(), 1e-9)

    def test_exponentials_agree_with_kornia(self):
        geometry = pytest.importorskip("kornia.geometry.liegroup")
        xi = random_tangents((8,), torch.float64)
        close(lie.se3_exp(xi), geometry.Se3.exp(xi).matrix(), 1e-12)
        close(lie.so3_exp(xi[..., 3:]), geometry.So3.exp(xi[..., 3:]).matrix(), 1e-12)
        close(lie.so3_log(lie.so3_exp(xi[..., 3:])), geometry.So3.exp(xi[..., 3:]).log(), 1e-11)


class TestLogarithm:
    @pytest.mark.parametrize("angle", [*SMALL_ANGLES, 0.5, 1.5, 2.5, *ANGLES_NEAR_PI])
    @pytest.mark.parametrize("dtype", DTYPES)
    def test_rotation_vectors_come_back_below_pi(self, angle: float, dtype: torch.dtype):
        w = (angle * torch.tensor(AXES, dtype=torch.float64)).to(dtype)
        R = lie.so3_exp(w)
        log = lie.so3_log(R)
        # At pi - 1e-9 a float32 matrix cannot tell the two signs apart.
        flipped = (log * w).sum(-1, keepdim=True) < 0
        if dtype == torch.float32 and angle > 3.14159:
            log = torch.where(flipped, -log, log)
        close(log, w, 2e-6 if dtype == torch.float32 else 2e-15 + 4e-16 * angle)
        close(lie.so3_angle(R), torch.full((len(AXES),), angle, dtype=dtype), 2e-6 if dtype == torch.float32 else 4e-15)

    @pytest.mark.parametrize("angle", [1e-12, 1e-9, 1e-6, 1e-3])
    def test_small_angles_keep_their_relative_accuracy(self, angle: float):
        w = angle * torch.tensor(AXES, dtype=torch.float64)
        torch.testing.assert_close(lie.so3_log(lie.so3_exp(w)), w, rtol=1e-14, atol=1e-30)

    @pytest.mark.parametrize("dtype", DTYPES)
    @pytest.mark.parametrize("axis", AXES)
    def test_half_turns_give_their_axis_with_either_sign(self, axis: tuple[float, ...], dtype: torch.dtype):
        a = torch.tensor(axis, dtype=torch.float64)
        R = (2 * torch.outer(a, a) - torch.eye(3, dtype=torch.float64)).to(dtype)  # exactly pi about the axis
        log = lie.so3_log(R).double()
        close(torch.linalg.vector_norm(log), torch.tensor(math.pi, dtype=torch.float64), 4 * torch.finfo(dtype).eps)
        close((log @ a).abs(), torch.tensor(math.pi, dtype=torch.float64), 8 * torch.finfo(dtype).eps)
        close(lie.so3_exp(log), R.double(), 8 * torch.finfo(dtype).eps)

    @pytest.mark.parametrize("angle", [*SMALL_ANGLES, 1.0, *ANGLES_NEAR_PI, math.pi])
    def test_rigid_motions_come_back_up_to_pi(self, angle: float):
        w = angle * torch.tensor(AXES, dtype=torch.float64)
        xi = torch.cat([torch.tensor([0.3, -2.0, 1.1], dtype=torch.float64).expand_as(w), w], -1)
        T = lie.se3_exp(xi)
        close(lie.se3_exp(lie.se3_log(T)), T, 1e-13)

    def test_turns_beyond_pi_come_back_the_short_way(self):
        w = (math.tau - 1.0) * torch.tensor(AXES, dtype=torch.float64)
        close(lie.so3_log(lie.so3_exp(w)), -torch.tensor(AXES, dtype=torch.float64), 1e-14)

    @pytest.mark.parametrize("dtype", DTYPES)
    def test_no_angle_exceeds_pi(self, dtype: torch.dtype):
        R = lie.so3_exp(3.2 * torch.tensor(AXES, dtype=dtype))
        assert bool((lie.so3_angle(R) <= torch.tensor(math.pi, dtype=dtype) * (1 + 2 * torch.finfo(dtype).eps)).all())


class TestQuaternions:
    @pytest.mark.parametrize("dtype", DTYPES)
    @pytest.mark.parametrize("largest", range(4), ids=["x", "y", "z", "w"])
    def test_round_trip_whichever_component_is_largest(self, largest: int, dtype: torch.dtype):
        generator = torch.Generator().manual_seed(largest)
        q = 0.5 * torch.rand(50, 4, generator=generator, dtype=torch.float64) - 0.25
        q[:, largest] = 1.0
        q = torch.nn.functional.normalize(q, dim=-1).to(dtype)
        q = torch.where(q[:, 3:] < 0, -q, q)
        close(lie.quaternion_from_matrix(lie.matrix_from_quaternion(q)), q, 8 * torch.finfo(dtype).eps)

    def test_the_order_is_x_y_z_w(self):
        q = lie.quaternion_from_matrix(lie.so3_exp(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))
        close(q, torch.tensor([0.0, 0.0, math.sin(0.5), math.cos(0.5)], dtype=torch.float64), 1e-15)

    @pytest.mark.parametrize("batch", BATCHES)
    def test_any_length_and_either_sign_give_one_rotation(self, batch: tuple[int, ...]):
        q = torch.randn(*batch, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
        R = lie.matrix_from_quaternion(q)
        close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(*batch, 3, 3), 1e-14)
        for factor in (-1.0, 1e-6, 1e6):
            close(lie.matrix_from_quaternion(factor * q), R, 1e-14)
        assert bool((lie.quaternion_from_matrix(R)[..., 3] >= 0).all())


def seeds_of_gradients() -> list[Float[Tensor, "3"]]:
    angles = [0.0, 1e-12, 1e-6, 9.99e-3, 1.001e-2, 0.7, 2.0, math.pi - 1e-3]
    return [angle * torch.tensor([-0.36, 0.48, 0.8], dtype=torch.float64) for angle in angles]


@pytest.mark.parametrize("w", seeds_of_gradients(), ids=lambda w: f"angle={torch.linalg.vector_norm(w).item():.3g}")
class TestDerivatives:
    def test_exponentials_differentiate(self, w: Float[Tensor, "3"]):
        w = w.clone().requires_grad_()
        xi = torch.cat([w.new_tensor([0.3, -2.0, 1.1]), w]).detach().requires_grad_()
        assert torch.autograd.gradcheck(lie.so3_exp, (w,), atol=1e-7)
        assert torch.autograd.gradcheck(lie.se3_exp, (xi,), atol=1e-7)
        assert torch.autograd.gradgradcheck(lie.se3_exp, (xi,), atol=1e-5)
        close(jacfwd(lie.se3_exp)(xi), jacfwd(lambda x: torch.linalg.matrix_exp(hat_by_stacking(x)))(xi), 1e-11)

    def test_logarithms_differentiate_along_the_group(self, w: Float[Tensor, "3"]):
        """Logarithms are defined on the group alone: they are differentiated through a step exp(d) @ T."""
        xi = torch.cat([w.new_tensor([0.3, -2.0, 1.1]), w])
        T = lie.se3_exp(xi)
        d = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda d: lie.so3_log(lie.so3_exp(d[:3]) @ T[:3, :3]), (d,), atol=1e-6)
        assert torch.autograd.gradcheck(lambda d: lie.se3_log(lie.se3_exp(d) @ T), (d,), atol=1e-6)

    def test_log_after_exp_has_the_identity_as_its_derivative(self, w: Float[Tensor, "3"]):
        xi = torch.cat([w.new_tensor([0.3, -2.0, 1.1]), w])
        close(jacfwd(lambda x: lie.se3_log(lie.se3_exp(x)))(xi), torch.eye(6, dtype=torch.float64), 1e-9)
        similarity = torch.cat([xi, xi.new_tensor([0.2])])
        atol = 1e-9 if torch.linalg.vector_norm(w) < 3 else 1e-6
        x = similarity.requires_grad_()
        J = torch.autograd.functional.jacobian(lambda x: lie.sim3_log(lie.sim3_exp(x)), x)
        close(torch.as_tensor(J), torch.eye(7, dtype=torch.float64), atol)


@pytest.mark.parametrize("delta", [1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("axis", AXES)
def test_log_after_exp_has_the_identity_as_its_derivative_just_below_pi(axis: tuple[float, ...], delta: float):
    """Finite differences would step across pi here; forward mode does not."""
    w = (math.pi - delta) * torch.tensor(axis, dtype=torch.float64)
    xi = torch.cat([w.new_tensor([0.3, -2.0, 1.1]), w])
    close(jacfwd(lambda x: lie.se3_log(lie.se3_exp(x)))(xi), torch.eye(6, dtype=torch.float64), 1e-12)


def hat_by_stacking(xi: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
    """`se3_hat` without writing in place, for functional derivatives."""
    generators = se3_hat(torch.eye(6, dtype=xi.dtype))
    return torch.einsum("k,kij->ij", xi, generators)


HARD_ROTATIONS = torch.cat(
    [
        torch.zeros(1, 3, dtype=torch.float64),
        1e-20 * torch.tensor(AXES, dtype=torch.float64),
        *[
            angle * torch.tensor(AXES, dtype=torch.float64)
            for angle in (1e-12, 1e-2, math.pi - 1e-9, math.pi, math.tau)
        ],
    ]
)


@pytest.mark.parametrize("dtype", DTYPES)
class TestNothingIsEverNaN:
    def test_values_and_gradients_are_finite_at_every_hard_point(self, dtype: torch.dtype):
        w = HARD_ROTATIONS.to(dtype).requires_grad_()
        xi = torch.cat([torch.ones_like(w), w], -1)
        functions: list[tuple[str, Tensor]] = [
            ("so3_exp", lie.so3_exp(w)),
            ("so3_left_jacobian", lie.so3_left_jacobian(w)),
            ("se3_exp", lie.se3_exp(xi)),
            ("so3_log", lie.so3_log(lie.so3_exp(w))),
            ("so3_angle", lie.so3_angle(lie.so3_exp(w))),
            ("se3_log", lie.se3_log(lie.se3_exp(xi))),
            ("quaternion", lie.quaternion_from_matrix(lie.so3_exp(w))),
            ("sim3_log", lie.sim3_log(lie.sim3_exp(torch.cat([xi, torch.zeros_like(w[:, :1])], -1)))),
        ]
        for name, value in functions:
            (gradient,) = torch.autograd.grad(value.sum(), w)
            assert bool(torch.isfinite(value).all()), name
            assert bool(torch.isfinite(gradient).all()), name

    def test_the_exact_half_turns_have_finite_logarithms_and_gradients(self, dtype: torch.dtype):
        a = torch.tensor(AXES, dtype=dtype)
        R = 2 * a[:, :, None] * a[:, None, :] - torch.eye(3, dtype=dtype)
        R.requires_grad_()
        log = lie.so3_log(R)
        (gradient,) = torch.autograd.grad(log.sum(), R)
        assert bool(torch.isfinite(log).all())
        assert bool(torch.isfinite(gradient).all())


class TestConventions:
    def test_updates_multiply_from_the_left_with_translation_first(self):
        """T <- exp(xi) @ T, xi = [v, w]: a small step moves the point p_a of T_b_a to p_b + v + w x p_b."""
        T_b_a = lie.se3_exp(random_tangents((), torch.float64, seed=20))
        p_a = torch.tensor([0.4, -1.3, 2.2, 1.0], dtype=torch.float64)
        p_b = (T_b_a @ p_a)[:3]
        J_p_xi = jacfwd(lambda xi: (lie.se3_exp(xi) @ T_b_a @ p_a)[:3])(torch.zeros(6, dtype=torch.float64))
        close(
            J_p_xi, torch.cat([torch.eye(3, dtype=torch.float64), -se3_hat(torch.cat([p_b, p_b]))[:3, :3]], -1), 1e-13
        )

    def test_a_positive_turn_about_y_takes_forward_to_the_right(self):
        quarter = lie.so3_exp(torch.tensor([0.0, math.pi / 2, 0.0], dtype=torch.float64))
        forward, right = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
        close(quarter @ forward, right, 1e-15)

    def test_relative_perturbations_of_two_frames_chain_through_the_adjoint(self):
        """With T_ji = T_j T_i^-1, both perturbed from the left, d/dxi_i = -d/dxi_j Ad(T_ji) (mathematics.md, 6)."""
        T_i, T_j = (lie.se3_exp(random_tangents((), torch.float64, seed=seed)) for seed in (21, 22))
        p_i = torch.tensor([0.4, -1.3, 2.2, 1.0], dtype=torch.float64)
        zero = torch.zeros(6, dtype=torch.float64)

        def point(xi_i: Tensor, xi_j: Tensor) -> Tensor:
            return (lie.se3_exp(xi_j) @ T_j @ lie.se3_inverse(lie.se3_exp(xi_i) @ T_i) @ p_i)[:3]

        J_i, J_j = jacfwd(point, argnums=(0, 1))(zero, zero)
        close(J_i, -J_j @ lie.se3_adjoint(T_j @ lie.se3_inverse(T_i)), 1e-12)

    @pytest.mark.parametrize(
        ("function", "shape", "name"),
        [
            (lie.so3_exp, (4,), "w"),
            (lie.so3_log, (4, 4), "R"),
            (lie.se3_exp, (5,), "xi"),
            (lie.se3_log, (3, 4), "T"),
            (lie.se3_inverse, (3, 3), "T"),
            (lie.se3_adjoint, (6,), "T"),
            (lie.sim3_exp, (6,), "xi"),
            (lie.sim3_log, (3, 3), "S"),
            (lie.matrix_from_quaternion, (3,), "q"),
        ],
    )
    def test_wrong_shapes_are_refused_by_name(self, function: Exp, shape: tuple[int, ...], name: str):
        with pytest.raises(ShapeError, match=rf"^{name}: expected shape \[.*\], got \[{shape[0]}"):
            function(torch.zeros(shape))


def test_the_small_adjoint_of_sim3_generates_its_adjoint():
    xi = 0.8 * torch.randn(20, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    adjoint = lie.sim3_adjoint(lie.sim3_exp(xi))
    torch.testing.assert_close(torch.linalg.matrix_exp(lie.sim3_small_adjoint(xi)), adjoint, atol=1e-11, rtol=0)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 1.5])
def test_the_left_jacobian_of_sim3_is_that_of_finite_differences(size):
    xi = size * torch.randn(5, 7, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    step = 1e-6 * torch.eye(7, dtype=torch.float64)[:, None]
    ahead, behind = lie.sim3_exp(xi + step), lie.sim3_exp(xi - step)
    numeric = lie.sim3_log(ahead @ lie.sim3_inverse(behind)) / 2e-6
    torch.testing.assert_close(lie.sim3_left_jacobian(xi), numeric.movedim(0, -1), atol=1e-7, rtol=1e-7)
