import os
import re

import numpy as np
import pytest
from raising import raises

from gsmap.errors import InputError
from gsmap.formats import info, ply, read, stream, write
from gsmap.formats.scans import holds_splat
from gsmap.geometry.sh import SH_C0
from gsmap.types import Gaussians

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")


def some(n: int = 70_000, degree: int = 3) -> Gaussians:
    rng = np.random.default_rng(7)
    return Gaussians(
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(size=(n, 3)),
        rng.normal(size=n),
        rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )


def assert_same(a: Gaussians, b: Gaussians) -> None:
    for name in NAMES:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def columns(g: Gaussians) -> dict[str, np.ndarray]:
    """The INRIA columns by their published meaning (f_rest is channel-major: all of red first)."""
    out = {a: g.means[:, i] for i, a in enumerate("xyz")}
    rest = g.sh.shape[1] - 1
    for c in range(3):
        out[f"f_dc_{c}"] = g.sh[:, 0, c]
        for j in range(rest):
            out[f"f_rest_{c * rest + j}"] = g.sh[:, 1 + j, c]
    out["opacity"] = g.logit_opacities
    out |= {f"scale_{i}": g.log_scales[:, i] for i in range(3)}
    return out | {f"rot_{i}": g.quats[:, i] for i in range(4)}


def save(path, table: dict[str, np.ndarray], *, kinds=None, encoding="binary_little_endian", comments=(), eol="\n"):
    kinds = kinds or {}
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(encoding, "=")
    n = len(next(iter(table.values())))
    lines = ["ply", f"format {encoding} 1.0", *(f"comment {c}" for c in comments), f"element vertex {n}"]
    lines += [f"property {kinds.get(k, 'float')} {k}" for k in table]
    rows = np.empty(n, [(k, order + ply._TYPES[kinds.get(k, "float")]) for k in table])
    for k, v in table.items():
        rows[k] = v
    with open(path, "wb") as f:
        f.write((eol.join([*lines, "end_header"]) + eol).encode())
        if encoding == "ascii":
            f.writelines((" ".join(repr(x.item()) for x in row) + "\n").encode() for row in rows)
        else:
            f.write(rows.tobytes())
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path, degree):
    g = some(degree=degree)
    write(tmp_path / "a.ply", g)
    assert_same(read(tmp_path / "a.ply"), g)


def test_written_layout_is_inria(tmp_path):
    g = some(10, 3)
    write(tmp_path / "a.ply", g)
    header = ply.read_header(tmp_path / "a.ply")
    names = header.elements["vertex"].dtype.names
    assert names[:9] == ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
    assert names[9:54] == tuple(f"f_rest_{i}" for i in range(45))
    assert names[54:] == ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    rows = ply.read_element(tmp_path / "a.ply", header, "vertex")
    for name, column in columns(g).items():
        np.testing.assert_array_equal(rows[name], column)


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("eol", ["\n", "\r\n"])
def test_any_order_types_and_encoding(tmp_path, encoding, eol):
    g = some(50, 2)
    table = columns(g)
    names = list(table)
    np.random.default_rng(1).shuffle(names)
    shuffled = {"class": np.arange(50) % 200} | {n: table[n] for n in names}
    kinds = {"class": "uchar", "x": "double", "rot_2": "float64"}
    path = save(tmp_path / "a.ply", shuffled, kinds=kinds, encoding=encoding, eol=eol)
    assert_same(read(path), g)
    path = save(tmp_path / "b.ply", {n: table[n] for n in names}, encoding=encoding)
    assert_same(read(path), g)


def test_reads_what_another_writer_wrote(tmp_path):
    gsply = pytest.importorskip("gsply")
    g = some(1000, 3)
    gsply.plywrite(
        str(tmp_path / "a.ply"), g.means, g.log_scales, g.quats, g.logit_opacities, g.sh[:, 0], g.sh[:, 1:].copy()
    )
    assert_same(read(tmp_path / "a.ply"), g)
    write(tmp_path / "b.ply", g)
    other = gsply.plyread(str(tmp_path / "b.ply"))
    np.testing.assert_array_equal(other.means, g.means)
    np.testing.assert_array_equal(np.asarray(other.shN).reshape(1000, 15, 3), g.sh[:, 1:])


def test_colours_from_uchar_rgb(tmp_path):
    g = some(20, 0)
    table = {k: v for k, v in columns(g).items() if not k.startswith("f_dc")}
    rgb = np.arange(60).reshape(20, 3) * 4
    table |= {name: rgb[:, i] for i, name in enumerate(("red", "green", "blue"))}
    path = save(tmp_path / "a.ply", table, kinds=dict.fromkeys(("red", "green", "blue"), "uchar"))
    np.testing.assert_allclose(0.5 + SH_C0 * read(path).sh[:, 0], rgb / 255, atol=1e-6)
    assert "colours" in info(path).notes[0]


def test_2dgs_becomes_flat(tmp_path):
    table = columns(some(20, 1))
    del table["scale_2"]
    path = save(tmp_path / "a.ply", table)
    scales = read(path).scales
    np.testing.assert_allclose(scales[:, 2], 1e-3 * scales[:, :2].min(1), rtol=1e-4)
    assert "2DGS" in info(path).notes[0]


def test_mip_filter_keeps_the_integral(tmp_path):
    g = some(100, 0)
    size = np.random.default_rng(3).uniform(0, 2, 100)
    path = save(tmp_path / "a.ply", columns(g) | {"filter_3D": size})
    out = read(path)
    np.testing.assert_allclose(out.scales, np.hypot(g.scales, size[:, None]), rtol=1e-5)
    np.testing.assert_allclose(
        out.opacities * out.scales.prod(1), g.opacities * g.scales.prod(1), rtol=1e-3
    )  # Gaussian mass is kept
    assert info(path).antialiased


@pytest.mark.parametrize("comment", ["SplatRenderMode: mip", "Generated by Postshot, antialiased"])
def test_antialiased_is_noted(tmp_path, comment):
    assert info(save(tmp_path / "a.ply", columns(some(2, 0)), comments=[comment])).antialiased
    assert not info(save(tmp_path / "b.ply", columns(some(2, 0)))).antialiased
    write(tmp_path / "c.ply", some(2, 0), antialiased=True)
    assert info(tmp_path / "c.ply").antialiased


@pytest.mark.parametrize(
    "comment",
    ["antialiased 0", "Postshot antialiased: 0", "antialiased=false", "Antialiased off", "not antialiased", "sh 0"],
)
def test_what_is_said_not_to_be_antialiased_is_not(tmp_path, comment):
    assert not info(save(tmp_path / "a.ply", columns(some(2, 0)), comments=[comment])).antialiased


@pytest.mark.parametrize("comment", ["antialiased 1", "antialiased: true", "antialiased 0.3", "antialiased=yes, v 0"])
def test_what_is_said_to_be_antialiased_is(tmp_path, comment):
    assert info(save(tmp_path / "a.ply", columns(some(2, 0)), comments=[comment])).antialiased


def test_other_elements_around_the_vertices(tmp_path):
    g = some(5, 0)
    rows = np.stack(list(columns(g).values()), 1).astype("<f4")
    head = "ply\nformat binary_little_endian 1.0\nelement extra 3\nproperty short a\nelement vertex 5\n"
    head += "".join(f"property float {n}\n" for n in columns(g)) + "element face 1\nproperty list uchar int v\n"
    (tmp_path / "a.ply").write_bytes((head + "end_header\n").encode() + b"\0" * 6 + rows.tobytes() + b"\x01\0\0\0\0")
    assert_same(read(tmp_path / "a.ply"), g)


BASE = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + "".join(
    f"property float {n}\n" for n in columns(some(1, 0))
)
MALFORMED = {
    "empty": (b"", "wrong_file_type", "it is empty"),
    "magic": (b"plx\nformat ascii 1.0\n", "wrong_file_type", "b'plx"),
    "png": (b"\x89PNG\r\n\x1a\n" + b"\0" * 100, "wrong_file_type", "x89PNG"),
    "no newline": (b"ply\n" + b"x" * 1_000_000, "ply_header", "64 KiB"),
    "no newline at all": (b"ply\n" + b"x" * 100, "ply_header", "before the file ends"),
    "endless header": (b"ply\nformat ascii 1.0\n" + b"comment x\n" * 10_000, "ply_header", "64 KiB"),
    "no end": ((BASE.format(3)).encode(), "ply_header", "before the file ends"),
    "no format": (b"ply\nelement vertex 0\nend_header\n", "ply_header", "no 'format'"),
    "bad format": (b"ply\nformat middle_endian 1.0\nend_header\n", "ply_header", "line 2 "),
    "count 3e8": (
        (BASE.format(300_000_000) + "end_header\n").encode() + b"\0" * 560,
        "file_truncated",
        "300000000 vertex rows",
    ),
    "count 1e12": (
        (BASE.format(10**12) + "end_header\n").encode() + b"\0" * 560,
        "file_truncated",
        "1000000000000 vertex rows",
    ),
    "count 1e30": ((BASE.format(10**30) + "end_header\n").encode(), "ply_header", "line 3 "),
    "count -1": ((BASE.format(-1) + "end_header\n").encode(), "ply_header", "line 3 "),
    "zero": ((BASE.format(0) + "end_header\n").encode(), "no_gaussians", "no vertex rows"),
    "short data": ((BASE.format(10) + "end_header\n").encode() + b"\0" * 559, "file_truncated", "10 vertex rows"),
    "bad type": (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n", "ply_header", "line 4 "),
    "duplicate": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nproperty int x\nend_header\n",
        "duplicate",
        "element 'vertex'",
    ),
    "orphan property": (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "ply_header", "line 3 "),
    "points only": (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        b"property float z\nend_header\n" + b"\0" * 12,
        "not_gaussians",
        "lack f_dc_0.*rot_3",
    ),
    "mesh": (
        b"ply\nformat ascii 1.0\nelement vertex 2\nproperty list uchar int x\nend_header\n1 2\n",
        "ply_properties",
        "list property",
    ),
    "no columns": (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n",
        "ply_properties",
        "no properties",
    ),
    "bad SH": (
        (BASE.format(1) + "property float f_rest_0\nend_header\n").encode() + b"\0" * 60,
        "unsupported_sh_degree",
        "1 f_rest",
    ),
    "ascii words": (
        (BASE.format(1).replace("binary_little_endian", "ascii") + "end_header\n").encode() + b"a " * 14,
        "invalid_row",
        "string 'a'",
    ),
    "ascii short": (
        (BASE.format(2).replace("binary_little_endian", "ascii") + "end_header\n").encode() + b"1.5 " * 13 + b"1.555\n",
        "file_truncated",
        "2 rows promised, 1 found",
    ),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_is_refused_in_one_line(tmp_path, case):
    data, code, match = MALFORMED[case]
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    with raises(InputError, code=code, match=match) as caught:
        read(path)
    assert "\n" not in str(caught.value)
    assert "bad.ply" in str(caught.value)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize(("promised", "found"), [("7", "13"), ("20", "13")])
def test_a_header_that_promises_another_number_of_rows_is_refused(tmp_path, encoding, promised, found):
    path = save(tmp_path / "a.ply", columns(some(13, 0)), encoding=encoding)
    path.write_bytes(path.read_bytes().replace(b"element vertex 13", b"element vertex " + promised.encode()))
    with pytest.raises(InputError) as refused:
        read(path)
    more = int(found) - int(promised)
    assert re.search(rf"\b{promised} (vertex )?rows", str(refused.value))
    assert re.search(rf"\b({found}|{more}) (rows|found)", str(refused.value))


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_rows_may_end_in_white_space_and_other_elements_may_follow(tmp_path, encoding):
    g = some(13, 0)
    path = save(tmp_path / "a.ply", columns(g), encoding=encoding)
    path.write_bytes(path.read_bytes() + b"\n\n")
    assert_same(read(path), g)
    path = save(tmp_path / "a.ply", columns(g), encoding=encoding)
    later = b"1\n2\n" if encoding == "ascii" else b"\1\2"
    data = path.read_bytes().replace(b"end_header", b"element version 2\nproperty uchar number\nend_header")
    path.write_bytes(data + later)
    assert_same(read(path), g)
    path.write_bytes(data + later + later)
    with pytest.raises(InputError):
        read(path)


def test_every_truncation_is_refused(tmp_path):
    write(tmp_path / "a.ply", some(4, 1))
    data = (tmp_path / "a.ply").read_bytes()
    for size in range(len(data)):
        (tmp_path / "b.ply").write_bytes(data[:size])
        with pytest.raises(InputError):
            read(tmp_path / "b.ply")


def test_mutations_are_read_or_refused(tmp_path):
    """Any damage of a small file ends in Gaussians or a typed error, within the memory of the file."""
    write(tmp_path / "a.ply", some(4, 1))
    whole = (tmp_path / "a.ply").read_bytes()
    rng = np.random.default_rng(11)
    words = [
        b"0",
        b"9" * 12,
        b"-1",
        b"list",
        b"property",
        b"element vertex",
        b"\n",
        b"\0",
        b"ascii",
        b"\xff",
        b"double",
    ]
    refused = 0
    for _ in range(1500):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(data)))
            kind = rng.integers(4)
            if kind == 0:
                data[at] ^= 1 << int(rng.integers(8))
            elif kind == 1:
                del data[at : at + int(rng.integers(1, 40))]
            elif kind == 2:
                data[at:at] = words[rng.integers(len(words))]
            else:
                data[at:at] = data[int(rng.integers(len(data))) :][: int(rng.integers(1, 60))]
        (tmp_path / "b.ply").write_bytes(data)
        try:
            assert len(read(tmp_path / "b.ply")) * 4 <= len(data)
            info(tmp_path / "b.ply")
        except InputError:
            refused += 1
    assert 300 < refused < 1500


def test_real_capture(shared_data):
    g = read(shared_data / "house" / "c0.ply")
    assert len(g) == 152_000
    assert g.sh_degree == 1
    assert np.isfinite(g.means).all()


def test_further_properties_ride_along_and_are_skipped_when_read(tmp_path):
    n = 5
    gaussians = Gaussians(
        np.zeros((n, 3)), np.tile([1, 0, 0, 0], (n, 1)), np.zeros((n, 3)), np.arange(n), np.ones((n, 4, 3))
    )
    write(tmp_path / "a.ply", gaussians, extra={"scene": np.arange(n) % 2})
    back = read(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.logit_opacities, gaussians.logit_opacities)
    content = (tmp_path / "a.ply").read_bytes()
    header, body = content.split(b"end_header\n")
    assert header.endswith(b"property float scene\n")
    np.testing.assert_array_equal(np.frombuffer(body, "<f4").reshape(n, -1)[:, -1], np.arange(n) % 2)


@pytest.mark.filterwarnings("error")
def test_lines_without_data_among_ascii_rows_are_left_out_in_silence(tmp_path):
    text = BASE.format(2).replace("binary_little_endian", "ascii") + "end_header\n"
    (tmp_path / "a.ply").write_text(text + "1 " * 14 + "\n\n \n" + "2 " * 14 + "\n")
    np.testing.assert_array_equal(read(tmp_path / "a.ply").means[:, 0], [1, 2])


def test_a_file_that_is_written_to_while_it_is_read_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    write(path, some(100))
    source = stream(path)
    assert source.num_gaussians == 100
    assert len(list(source.chunks())) == 1
    before = path.stat()
    write(path, some(100))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    with raises(InputError, code="file_changed"):
        list(source.chunks())
    with raises(InputError, code="file_changed"):
        list(source.columns("means"))


def test_a_ply_is_copied_chunk_by_chunk(tmp_path, monkeypatch):
    write(tmp_path / "a.ply", some(degree=1))
    monkeypatch.setattr(ply.PlySource, "load", None)
    write(tmp_path / "b.ply", stream(tmp_path / "a.ply"))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def trained(n: int = 5_000, degree: int = 1) -> Gaussians:
    """Gaussians over a floor of 10 by 10 units, as trainers leave them: half of them faint, all a few cm wide."""
    rng = np.random.default_rng(3)
    return Gaussians(
        rng.uniform(0, 10, (n, 3)) * [1, 1, 0.01],
        rng.normal(size=(n, 4)),
        rng.normal(np.log(0.03), 0.5, (n, 3)),
        rng.normal(0, 4, n),
        rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )


def test_columns_named_as_cloudcompare_names_them_are_those_of_a_splat(tmp_path):
    g = trained()
    table = {name if name in "xyz" else f"scalar_{name}": values for name, values in columns(g).items()}
    table["scalar_intensity"] = g.means[:, 0]
    kinds = dict.fromkeys("xyz", "double")
    for encoding in ("ascii", "binary_little_endian"):
        path = save(tmp_path / "a.ply", table, kinds=kinds, encoding=encoding)
        assert_same(read(path), g)
        assert any("CloudCompare" in note for note in info(path).notes)
    assert holds_splat(path)
    assert not any("CloudCompare" in note for note in info(save(tmp_path / "b.ply", columns(g))).notes)


def activated(g: Gaussians) -> dict[str, np.ndarray]:
    table = columns(g)
    table["opacity"] = 1 / (1 + np.exp(-g.logit_opacities.astype(np.float64)))
    return table | {f"scale_{i}": np.exp(g.log_scales[:, i].astype(np.float64)) for i in range(3)}


def test_activated_opacities_and_scales_are_read_as_such(tmp_path):
    g = trained()
    path = save(tmp_path / "a.ply", activated(g), kinds={"opacity": "double"})
    back = read(path)
    np.testing.assert_allclose(back.log_scales, g.log_scales, atol=1e-5)
    seen = np.abs(g.logit_opacities) < 8
    np.testing.assert_allclose(back.logit_opacities[seen], g.logit_opacities[seen], atol=1e-2)
    assert any("lengths" in note for note in info(path).notes)
    solid = activated(g) | {"opacity": np.ones(len(g))}  # no evidence but that of the scales
    assert read(save(tmp_path / "b.ply", solid)).logit_opacities.min() > 5


def test_opacities_and_scales_of_two_conventions_are_refused(tmp_path):
    g = trained()
    for names in (["opacity"], [f"scale_{i}" for i in range(3)]):
        with raises(InputError, code="activated_values"):
            read(save(tmp_path / "a.ply", columns(g) | {name: activated(g)[name] for name in names}))


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e5, 1e-3])
def test_trained_values_stay_whatever_the_unit(tmp_path, unit):
    """In millimetres every logarithm of a scale is positive, and so is it of one capture in a small unit."""
    g = trained()
    log_scales = np.maximum(g.log_scales, -4) + np.float32(np.log(unit))
    other = Gaussians(g.means * unit, g.quats, log_scales, g.logit_opacities, g.sh)
    path = save(tmp_path / "a.ply", columns(other))
    assert_same(read(path), other)
    assert not info(path).notes
    for logit in (0.0, 0.5, 1.0):  # none of which is the opacity of a capture, but of what tests are made of
        plain = Gaussians(other.means, other.quats, log_scales, np.full(len(g), logit), other.sh)
        assert_same(read(save(tmp_path / "b.ply", columns(plain))), plain)
