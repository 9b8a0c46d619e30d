from __future__ import annotations

import numpy as np
import pytest

from posmas_fmi.agent import linear_agent
from posmas_fmi.design.integral import augmented, integral_design
from posmas_fmi.errors import DesignError
from posmas_fmi.network import Network, network_from_arcs

# a cooling line: plate, return and supply temperatures; heat retained at the supply
LINE = linear_agent(
    [[-0.1996, 0.0998, 0.0998], [0.0435, -0.0945, 0.0509], [0.0, 0.0485, -0.0727]],
    [[0.0], [0.0], [0.01]],
    [[0.0, 0.0, 1.0]],
    sector=(0.5, 1.5),
)


def ring() -> Network:
    return network_from_arcs(5, [(1, 2), (2, 3), (3, 4), (4, 5), (5, 1), (1, 4)], [1])


def test_offset_of_unequal_loads_vanishes_for_switching_slopes() -> None:
    network = ring()
    made = integral_design(LINE, network, LINE.C, rate=0.002)
    rng = np.random.default_rng(1)
    M = network.pinned_laplacian.toarray()
    A, B, _ = augmented(LINE, LINE.C)
    gain = np.hstack([made.K, made.K_q])
    # incremental form: z = (δ, w), w_i' = C_z δ_i; slopes fixed per agent, constant loads
    slopes = rng.uniform(0.5, 1.5, 5)
    J = np.kron(np.eye(5), A) + np.kron(np.diag(slopes) @ M, B @ gain)
    assert np.linalg.eigvals(J).real.max() <= -made.kappa + 1e-9
    load = np.zeros((5, 4))
    load[:, 0] = rng.uniform(0.0, 0.2, 5)
    steady = np.linalg.solve(-J, load.ravel()).reshape(5, 4)
    assert np.abs(steady[:, 2]).max() < 1e-9  # what is integrated has no offset
    assert np.abs(steady[:, 0]).max() > 0.1  # the rest carries the load


def test_quadratic_function_falls_for_every_time_varying_slope() -> None:
    network = ring()
    made = integral_design(LINE, network, LINE.C, rate=0.002)
    rng = np.random.default_rng(2)
    M = network.pinned_laplacian.toarray()
    A, B, _ = augmented(LINE, LINE.C)
    gain, theta = np.hstack([made.K, made.K_q]), made.graph.Theta
    for _ in range(500):
        z = rng.normal(size=(5, 4))
        slopes = rng.choice([0.5, 1.5], (5, 1))
        dz = z @ A.T + (slopes * (M @ z @ gain.T)) @ B.T
        value = float(theta @ np.einsum("ni,ij,nj->n", z, made.V, z))
        change = 2 * float(theta @ np.einsum("ni,ij,nj->n", z, made.V, dz))
        assert change <= -2 * made.kappa * value + 1e-9 * value


def test_a_rate_out_of_reach_is_a_clear_error() -> None:
    with pytest.raises(DesignError, match="rate"):
        integral_design(LINE, ring(), np.array([[0.0, 0.0, 0.0]]), rate=0.01)


def test_wrong_shape_of_what_is_integrated() -> None:
    with pytest.raises(DesignError, match="3 columns"):
        integral_design(LINE, ring(), np.eye(2), rate=0.01)
