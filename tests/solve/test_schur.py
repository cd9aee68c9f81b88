"""Eliminating the diagonal block changes nothing about the solution."""

import pytest
import torch

from torchvo360.solve.schur import back_substitute, reduce


@pytest.mark.parametrize(("D", "N"), [(1, 1), (6, 40), (24, 5), (3, 0)])
def test_reduced_and_whole_systems_have_one_solution(D, N):
    g = torch.Generator().manual_seed(D + N)
    J = torch.randn(D + 4 * N + 5, D, generator=g, dtype=torch.float64)
    rho = torch.zeros(len(J), N, dtype=torch.float64)
    rho[torch.arange(4 * N), torch.arange(4 * N) % max(N, 1)] = 1 + torch.rand(4 * N, generator=g, dtype=torch.float64)
    whole = torch.cat([J, rho], 1)
    slope = torch.randn(D + N, generator=g, dtype=torch.float64)
    H = whole.T @ whole
    expected = torch.linalg.solve(H, -slope)
    parts = H[D:, :D], H[D:, D:].diagonal(), slope[D:]
    A, b = reduce(H[:D, :D], slope[:D], *parts)
    assert torch.equal(A, A.T)
    x = torch.linalg.solve(A, b)
    torch.testing.assert_close(x, expected[:D])
    torch.testing.assert_close(back_substitute(x, *parts), expected[D:])
