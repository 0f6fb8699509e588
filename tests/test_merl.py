"""The `merl` BSDF: tables written from a closed form, networks against numpy, and what was measured."""

import mitsuba as mi
import numpy as np
import pytest
from helpers.merl_tables import closed_form, directions, evaluate, networks, nodes, write
from helpers.microfacets import direction, draw
from scipy.spatial.transform import Rotation


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    path = tmp_path_factory.mktemp("merl") / "table.binary"
    write(path, closed_form(*nodes()))
    return path


def rusinkiewicz(wi, wo):
    """(θh, θd, φd) of one pair, by rotations: of h to the normal, azimuth first."""
    h = (wi + wo) / np.linalg.norm(wi + wo)
    theta, phi = np.arccos(h[2]), np.arctan2(h[1], h[0])
    d = Rotation.from_euler("zy", [-phi, -theta]).apply(wi)
    return theta, np.arccos(d[2]), np.arctan2(d[1], d[0]), d


def test_a_table_is_read_and_interpolated(table):
    wi, wo = directions(300, 1), directions(300, 2)
    found = evaluate(mi.load_dict({"type": "merl", "filename": str(table)}), wi, wo)
    angles = np.array([rusinkiewicz(a, b)[:3] for a, b in zip(wi, wo)])
    np.testing.assert_allclose(found, closed_form(*angles.T) * wo[:, 2:], rtol=0.01)


def test_values_of_cells_are_where_the_database_has_them(tmp_path):
    """One cell alone, θh 14.4°, θd 50° and φd 70°."""
    values = np.zeros((90, 90, 180, 3))
    values[36, 50, 70] = [1.0, 2.0, 3.0]
    write(tmp_path / "one.binary", values)
    theta = (36 / 90) ** 2 * np.pi / 2
    d = np.array([np.sin(np.radians(50)) * np.cos(np.radians(70)), np.sin(np.radians(50)) * np.sin(np.radians(70)),
                  np.cos(np.radians(50))])  # fmt: skip
    turn = Rotation.from_euler("yz", [theta, 0.3])  # any azimuth
    wi, wo = turn.apply(d), turn.apply(d * [-1, -1, 1])
    found = evaluate(mi.load_dict({"type": "merl", "filename": str(tmp_path / "one.binary")}), wi[None], wo[None])
    np.testing.assert_allclose(found[0] / wo[2], [1, 2, 3], rtol=1e-3)


def test_it_is_reciprocal(table):
    wi, wo = directions(200, 3), directions(200, 4)
    bsdf = mi.load_dict({"type": "merl", "filename": str(table)})
    there, back = evaluate(bsdf, wi, wo) / wo[:, 2:], evaluate(bsdf, wo, wi) / wi[:, 2:]
    np.testing.assert_allclose(there, back, rtol=2e-3)


def test_what_was_not_measured_is_what_is_around_it(table, tmp_path):
    values = closed_form(*nodes())
    values[::3, ::2, ::2] = np.nan  # never a whole corner of eight
    values[20:23, 30:60, :, 0] = np.nan  # of one colour alone, all around: no colour of these cells is known
    values[80:] = np.nan
    write(tmp_path / "holes.binary", values)
    wi, wo = directions(300, 5, 50.0), directions(300, 6, 50.0)
    whole, holes = (evaluate(mi.load_dict({"type": "merl", "filename": str(path)}), wi, wo)
                    for path in (table, tmp_path / "holes.binary"))  # fmt: skip
    angles = np.array([rusinkiewicz(a, b)[:2] for a, b in zip(wi, wo)])
    cell = 90 * np.sqrt(angles[:, 0] / (np.pi / 2))
    known = ~((abs(cell - 21) < 2.1) & (abs(np.degrees(angles[:, 1]) - 44.5) < 16))
    np.testing.assert_allclose(whole[known], holes[known], rtol=0.05)
    assert (holes[~known] <= 1.2 * whole[~known]).all()
    grazing = evaluate(mi.load_dict({"type": "merl", "filename": str(tmp_path / "holes.binary")}),
                       directions(1, 7), np.array([[0.9999, 0, 0.014]]))  # fmt: skip
    assert np.isfinite(grazing).all() and (grazing >= 0).all()
    flat = np.array([[1.0, 0, 0.02]]), np.array([[0.98, 0.2, 0.02]])
    assert (evaluate(mi.load_dict({"type": "merl", "filename": str(tmp_path / "holes.binary")}), *flat) == 0).all()


def test_it_says_what_it_needs(table):
    with pytest.raises(RuntimeError, match="filename is missing"):
        mi.load_dict({"type": "merl"})
    before = mi.variant()
    try:
        mi.set_variant("scalar_rgb")
        with pytest.raises(RuntimeError, match=r"needs a variant llvm_\*_rgb or cuda_\*_rgb, not scalar_rgb"):
            mi.load_dict({"type": "merl", "filename": str(table)})
    finally:
        mi.set_variant(before)


def test_seen_from_the_light_it_is_the_cell_of_its_angle(table):
    """Camera and light at one place: θd = 0."""
    wi = directions(50, 11)
    found = evaluate(mi.load_dict({"type": "merl", "filename": str(table)}), wi, wi)
    theta = np.arccos(wi[:, 2])
    expected = closed_form(theta, 0 * theta, 0 * theta) * wi[:, 2:]  # φd says nothing, but a table has a value for each
    np.testing.assert_allclose(found[:, :2], expected[:, :2], rtol=0.01)


@pytest.mark.parametrize("viewer", [(0, 0), (40, -37), (75, 110)])
def test_directions_are_drawn_by_the_density(table, viewer):
    sample, pdf = mi.chi2.BSDFAdapter(
        "merl", f'<string name="filename" value="{table}"/>', wi=direction(*viewer).tolist()
    )
    test = mi.chi2.ChiSquareTest(mi.chi2.SphericalDomain(), sample, pdf, sample_dim=3, sample_count=500_000, ires=16)
    assert test.run(significance_level=0.01, test_count=3, quiet=True), test.messages


def test_directions_are_drawn_by_the_density_of_a_network(tmp_path):
    networks(tmp_path / "nets.npz")
    values = f'<string name="filename" value="{tmp_path}/nets.npz"/><string name="material" value="one"/>'
    sample, pdf = mi.chi2.BSDFAdapter("merl", values, wi=[0.6, 0.0, 0.8])
    test = mi.chi2.ChiSquareTest(mi.chi2.SphericalDomain(), sample, pdf, sample_dim=3, sample_count=500_000, ires=16)
    assert test.run(significance_level=0.01, test_count=1, quiet=True), test.messages


def test_drawn_directions_give_the_albedo(table):
    """By samples and by a sum over directions."""
    bsdf, wi = mi.load_dict({"type": "merl", "filename": str(table)}), directions(1, 8)
    _, weight = draw(bsdf, wi[0], 1 << 16)
    drawn = np.array(weight).reshape(3, -1).mean(1)
    mu, phi = np.meshgrid((np.arange(200) + 0.5) / 200, (np.arange(400) + 0.5) / 200 * np.pi, indexing="ij")
    wo = np.stack([np.sqrt(1 - mu**2) * np.cos(phi), np.sqrt(1 - mu**2) * np.sin(phi), mu], -1).reshape(-1, 3)
    summed = evaluate(bsdf, np.repeat(wi, len(wo), 0), wo).sum(0) * (2 * np.pi / len(wo))
    np.testing.assert_allclose(drawn, summed, rtol=0.02)


def test_a_network_is_what_numpy_makes_of_it(tmp_path):
    net = networks(tmp_path / "nets.npz")
    wi, wo = directions(200, 9, 60.0), directions(200, 10, 60.0)
    found = evaluate(
        mi.load_dict({"type": "merl", "filename": str(tmp_path / "nets.npz"), "material": "other"}), wi, wo
    )
    expected = []
    for a, b in zip(wi, wo):
        theta, difference, _, d = rusinkiewicz(a, b)
        if difference > np.radians(65):
            d[:2] *= np.sin(np.radians(65)) / np.linalg.norm(d[:2])
            d[2] = np.cos(np.radians(65))
        x = np.r_[np.sin(theta), 0, np.cos(theta), d]
        y = np.maximum(np.maximum(x @ net["w1"] + net["b1"], 0) @ net["w2"] + net["b2"], 0) @ net["w3"] + net["b3"]
        expected.append(np.maximum(np.exp(y) - 1, 0) * b[2])
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


def test_networks_are_near_what_was_measured(shared):
    """At θd = 0, where camera and light are at one place: to 9.5 % in the median, by what the data say."""
    nets, measured = shared / "data/brdf/nbrdf_merl_weights.npz", np.load(shared / "data/brdf/merl_colocated_slice.npz")
    theta = measured["theta_h_rad"][:60]
    wi = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], 1)
    deviations = []
    for name, values in list(zip(measured["names"], measured["values_rgb"]))[::9]:
        found = (
            evaluate(mi.load_dict({"type": "merl", "filename": str(nets), "material": str(name)}), wi, wi) / wi[:, 2:]
        )
        deviations.append(np.abs(found / values[:60] - 1)[np.isfinite(values[:60]) & (values[:60] > 0.01)])
    assert np.median(np.concatenate(deviations)) < 0.15


def test_what_is_no_material_is_one_clear_error(table, tmp_path):
    networks(tmp_path / "nets.npz")
    (tmp_path / "cut.binary").write_bytes(table.read_bytes()[:-8])
    (tmp_path / "other.binary").write_bytes(bytes(100))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04")
    np.savez(tmp_path / "empty.npz", names=["one"])
    layers = {"w1": (21, 6), "b1": (21,), "w2": (21, 21), "b2": (21,), "w3": (21, 3), "b3": (3,)}
    np.savez(tmp_path / "turned.npz", names=["one"], **{name: np.zeros((1, *shape)) for name, shape in layers.items()})
    for file, material, message in (
        ("cut.binary", "", "must have 4374000"),
        ("other.binary", "", r"begins with \[0, 0, 0\], must be \[90, 90, 180\]"),
        ("none.binary", "", "which is no file"),
        ("nets.npz", "gold", 'no material "gold"; must be one of one, other'),
        ("broken.npz", "one", "cannot be read as arrays of NumPy's, .npz"),
        ("turned.npz", "one", r"w1 is of shape \[1, 21, 6\], must be \[1, 6, 21\]"),
        ("empty.npz", "one", "has no array w1"),
        (str(table), "gold", "a table holds one alone"),
    ):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict({"type": "merl", "filename": str(tmp_path / file), "material": material})
