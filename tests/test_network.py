import networkx
import numpy as np
import paper
import pytest
import scipy.io
import scipy.sparse as sp
from hypothesis import example, given, settings
from hypothesis import strategies as st

from posmas_fmi.errors import NetworkError
from posmas_fmi.network import (
    Network,
    _gth,
    _power_iteration,
    generalised_connectivity,
    network_from_arcs,
)
from posmas_fmi.network_file import read_adjacency


def test_spectra_of_the_papers_graphs():
    values = np.sort_complex(np.linalg.eigvals(paper.network(1).laplacian.toarray()))
    np.testing.assert_allclose(values, [0, 1.5 - 0.8660j, 1.5 + 0.8660j, 3], atol=1e-4)
    values = np.linalg.eigvalsh(paper.network(2).laplacian.toarray())
    printed = [0, 0.1719, 0.8359, 1.1134, 2, 2.8347, 3.5362, 4.3729, 5.1352]
    np.testing.assert_allclose(values, printed, atol=5e-5)


@pytest.mark.parametrize(("pin", "p_max"), [(1, 6.5), (2, 5.0), (3, 14.0), (4, 5.0)])
def test_p_max_of_example_1(pin, p_max):
    assert paper.network(1, pin).p_max == pytest.approx(p_max)


def test_p_max_of_example_2():
    assert paper.network(2).p_max == pytest.approx(19.0)


def test_orientation_row_sums_are_in_degrees():
    network = network_from_arcs(3, [(1, 2), (3, 2, 0.5)], pinned=[1, 3])
    np.testing.assert_array_equal(network.in_degree, [0, 1.5, 0])
    np.testing.assert_array_equal(network.adjacency.toarray()[1], [1, 0, 0.5])


digraphs = st.integers(2, 9).flatmap(
    lambda n: st.tuples(
        st.just(n),
        st.lists(
            st.tuples(st.integers(1, n), st.integers(1, n), st.floats(0.1, 5)).filter(
                lambda arc: arc[0] != arc[1]
            ),
            unique_by=lambda arc: arc[:2],
            max_size=25,
        ),
        st.integers(1, n),
    )
)


@given(digraphs)
def test_the_leader_reaches_whom_networkx_says(graph):
    n, arcs, pin = graph
    network = network_from_arcs(n, arcs, pinned=[pin])
    reference = networkx.DiGraph()
    reference.add_nodes_from(range(1, n + 1))
    reference.add_edges_from((a, b) for a, b, _ in arcs)
    missing = set(range(1, n + 1)) - networkx.descendants(reference, pin) - {pin}
    assert network.unreached() == tuple(sorted(k - 1 for k in missing))
    if missing:
        with pytest.raises(NetworkError, match="no path leads from the leader"):
            _ = network.p
    else:
        assert (network.p > 0).all()
        np.testing.assert_allclose(network.pinned_laplacian @ network.p, 1.0, atol=1e-9)


@given(digraphs)
def test_perron_vector_is_the_left_null_vector(graph):
    n, arcs, pin = graph
    ring = [(k, k % n + 1, 1.0) for k in range(1, n + 1)]
    known = {arc[:2] for arc in arcs}
    arcs = arcs + [arc for arc in ring if arc[:2] not in known]
    network = network_from_arcs(n, arcs, pinned=[pin])
    f = network.perron
    assert (f > 0).all()
    assert f.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(f @ network.laplacian, 0.0, atol=1e-12)


@example((2, [(1, 2, 3.75), (2, 1, 4.0)], 1))
@settings(max_examples=20)
@given(digraphs)
def test_both_ways_to_the_perron_vector_agree(graph):
    n, arcs, _ = graph
    ring = [(k, k % n + 1, 1.0) for k in range(1, n + 1)]
    known = {arc[:2] for arc in arcs}
    network = network_from_arcs(n, arcs + [arc for arc in ring if arc[:2] not in known])
    direct = _gth(network.adjacency.toarray())
    np.testing.assert_allclose(
        _power_iteration(network.adjacency, network.in_degree), direct, rtol=1e-8
    )


def test_tiny_entries_of_the_perron_vector_keep_their_accuracy():
    """A chain with weak arcs back: f spans 1e-72, each entry to machine precision."""
    n, weak = 13, 1e-6
    forward = [(k + 1, k, weak) for k in range(1, n)]
    arcs = forward + [(k, k + 1, 1.0) for k in range(1, n)]
    f = network_from_arcs(n, arcs, pinned=[1]).perron
    ratios = f[1:] / f[:-1]
    np.testing.assert_allclose(ratios, weak, rtol=1e-12)
    assert f.min() / f.max() == pytest.approx(1e-72, rel=1e-10)


def test_generalised_connectivity_of_an_undirected_graph_is_scaled_lambda_2():
    network = paper.network(2)
    f = np.full(9, 1 / 9)
    assert generalised_connectivity(network.laplacian, f) == pytest.approx(0.1719, abs=5e-5)
    assert network.algebraic_connectivity == pytest.approx(0.1719, abs=5e-5)


def test_perron_needs_strong_connection():
    with pytest.raises(NetworkError, match="strongly connected"):
        _ = network_from_arcs(2, [(1, 2)], pinned=[1]).perron


@pytest.mark.parametrize(
    ("agents", "arcs", "pinned", "place"),
    [
        (0, [], [], "$.network.agents"),
        (2, [(1, 3)], [], "$.network.arcs[0]"),
        (2, [(1, 2), (0, 1)], [], "$.network.arcs[1]"),
        (2, [(1, 1.5)], [], "$.network.arcs[0]"),
        (2, [(1, 1)], [], "$.network.arcs[0]"),
        (2, [(1, 2), (1, 2)], [], "$.network.arcs[1]"),
        (2, [(1,)], [], "$.network.arcs[0]"),
        (2, [(1, 2, -1.0)], [], "$.network.arcs"),
        (2, [(1, 2, np.nan)], [], "$.network.arcs"),
        (2, [(1, 2)], [3], "$.network.pinned[0]"),
        (2, [(1, 2)], {1: -1.0}, "$.network.pinned"),
    ],
)
def test_bad_networks_are_refused_by_place(agents, arcs, pinned, place):
    with pytest.raises(NetworkError) as caught:
        network_from_arcs(agents, arcs, pinned)
    assert caught.value.where == place


def test_unreached_agents_are_named():
    network = network_from_arcs(3, [(1, 2)], pinned=[1], names=["left", "right", "far"])
    with pytest.raises(NetworkError, match=r"agent.s. far; pin one of them"):
        network.require_reached()


def test_every_file_form_gives_the_same_network(tmp_path):
    network = paper.network(1)
    csv = tmp_path / "arcs.csv"
    csv.write_text("from,to\n" + "\n".join(f"{a},{b}" for a, b in paper.ARCS_1))
    mtx = tmp_path / "net.mtx"
    scipy.io.mmwrite(mtx, network.adjacency)
    graphml = tmp_path / "net.graphml"
    graph = networkx.DiGraph()
    graph.add_nodes_from(["1", "2", "3", "4"])
    graph.add_edges_from((str(a), str(b)) for a, b in paper.ARCS_1)
    networkx.write_graphml(graph, graphml)
    for path in (csv, mtx, graphml):
        adjacency, names = read_adjacency(path)
        np.testing.assert_array_equal(adjacency.toarray(), network.adjacency.toarray())
        assert names == ("1", "2", "3", "4")


def test_named_nodes_of_a_csv(tmp_path):
    path = tmp_path / "arcs.csv"
    path.write_text("from,to,weight\nnorth,south,2\nsouth,north,3\n")
    adjacency, names = read_adjacency(path)
    assert names == ("north", "south")
    np.testing.assert_array_equal(adjacency.toarray(), [[0, 3], [2, 0]])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.csv", b""),
        ("a.csv", b"to,from\n1,2\n"),
        ("a.csv", b"from,to\n1\n"),
        ("a.csv", b"from,to\n"),
        ("a.csv", b"from,to\n0,1\n"),
        ("a.csv", b"from,to,weight\n1,2,x\n"),
        ("a.csv", b"\xff\xfe\x00"),
        ("a.mtx", b"hello"),
        ("a.graphml", b"<x"),
        ("a.xlsx", b"hello"),
    ],
)
def test_bad_files_are_one_clear_error(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(NetworkError) as caught:
        read_adjacency(path)
    assert caught.value.where == "$.network.file"


def test_negative_weights_of_a_sparse_matrix_are_refused():
    with pytest.raises(NetworkError):
        Network(sp.csr_array([[0.0, -1.0], [0.0, 0.0]]), [1.0, 0.0])


@pytest.mark.parametrize("shape", ["random", "path"])
def test_large_networks_are_solved_whatever_their_structure(shape: str) -> None:
    n = 2500
    rng = np.random.default_rng(0)
    if shape == "random":
        hearing = np.repeat(np.arange(n), 5)
        heard = (hearing + rng.integers(1, n, 5 * n)) % n
    else:  # the Krylov method fails here, the factorisation is cheap
        hearing, heard = np.arange(1, n), np.arange(n - 1)
    adjacency = sp.csr_array((np.ones(len(hearing)), (hearing, heard)), shape=(n, n))
    pinning = np.zeros(n)
    pinning[0] = 1.0
    network = Network(adjacency, pinning)
    assert network.pinned_laplacian @ network.p == pytest.approx(np.ones(n), abs=1e-6)
    assert network.p.min() > 0
