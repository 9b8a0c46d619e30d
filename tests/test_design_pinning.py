import itertools

import numpy as np
import paper
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posmas_fmi.design import pinning
from posmas_fmi.design.pinning import place, root_components
from posmas_fmi.errors import NetworkError
from posmas_fmi.network import network_from_arcs

networks = st.integers(2, 7).flatmap(
    lambda n: st.lists(
        st.tuples(st.integers(1, n), st.integers(1, n)).filter(lambda arc: arc[0] != arc[1]),
        unique=True,
        max_size=20,
    ).map(lambda arcs: network_from_arcs(n, arcs))
)


def best_by_trying(network, count):
    found = [
        network.with_pinned(pinned).p_max
        for pinned in itertools.combinations(range(network.N), count)
        if not network.with_pinned(pinned).unreached()
    ]
    return min(found, default=None)


def test_example_1_says_what_the_choice_is_worth():
    placement = place(paper.network(1), 1)
    assert placement.pinned == (1,)
    assert placement.p_max == pytest.approx(5.0)
    assert placement.worst == pytest.approx(14.0)  # agent 3
    assert "worst reaches 14" in placement.note(paper.network(1).names)


@given(networks, st.integers(1, 3))
def test_exhaustive_choice_is_the_best_and_the_bound_holds(network, count):
    count = min(count, network.N)
    best = best_by_trying(network, count)
    if best is None:
        assert len(root_components(network)) > count
        with pytest.raises(NetworkError, match="hear nobody outside"):
            place(network, count)
        return
    placement = place(network, count)
    assert placement.p_max == pytest.approx(best)
    assert placement.lower_bound <= best * (1 + 1e-9)
    assert network.with_pinned(placement.pinned).p_max == pytest.approx(best)


@settings(max_examples=50)
@given(networks, st.integers(1, 3))
def test_greedy_choices_reach_everybody_and_know_their_distance(network, count):
    count = min(count, network.N)
    roots = root_components(network)
    if len(roots) > count:
        return
    best = best_by_trying(network, count)
    bound = pinning._lower_bound(network, roots, count)
    for choice in (pinning._Dense(network), pinning._Sparse(network)):
        pinned = pinning._greedy(choice, roots, count)
        assert len(set(pinned)) == count
        value = network.with_pinned(pinned).p_max
        assert bound * (1 - 1e-9) <= best * (1 + 1e-9) <= value * (1 + 2e-9)


def test_exchange_mends_a_greedy_choice():
    """On Example 2 greedy takes agents 6 and 1; exchanging them finds the best pair."""
    network = paper.network(2)
    choice = pinning._Dense(network)
    greedy = pinning._greedy(choice, root_components(network), 2)
    mended = pinning._exchange(choice, network, greedy)
    best = best_by_trying(network, 2)
    assert network.with_pinned(greedy).p_max > 1.5 * best
    assert network.with_pinned(mended).p_max == pytest.approx(best)


def test_one_rank_one_update_serves_every_candidate():
    network = paper.network(2)
    values = [network.with_pinned([3, j]).p_max for j in range(9)]
    values[3] = np.inf
    assert pinning._Dense(network).next([3]) == int(np.argmin(values))


@pytest.mark.parametrize("count", [0, 10])
def test_impossible_numbers_of_pins_are_refused(count):
    with pytest.raises(NetworkError, match="expected 1 to 9 pins"):
        place(paper.network(2), count)
