import numpy as np
import pytest
from linear_system import Autonomous

from training.records import Record, Signals, read_records

T = np.arange(200) * 0.05
Y = np.sin(T)


def quiet(text):
    raise AssertionError(text)


def npz(path, **arrays):
    np.savez(path, **{"t": T, "y": Y[:, None], **arrays})
    return path


def csv(path, header="time,theta,alpha,note", rows=None):
    rows = rows or [f"{t},{y},{2 * y},kept" for t, y in zip(T, Y)]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_npz(tmp_path):
    u, x = np.cos(T)[:, None], np.stack([Y, np.cos(T)], -1)
    (record,) = read_records([npz(tmp_path / "a.npz", u=u, x=x)], warn=quiet)
    assert record.signals == Signals("t", ("y",), ("u",), ("x1", "x2"))
    for found, expected in ((record.t, T), (record.y, Y[:, None]), (record.u, u), (record.x, x)):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_by_names(tmp_path, separator):
    path = csv(tmp_path / "a.csv")
    path.write_text("\ufeff" + path.read_text().replace(",", separator) + "\n\n", encoding="utf-8")
    signals = Signals(measured=("theta",), hidden=("cos(alpha)", "sin(alpha)", "alpha"))
    (record,) = read_records([path], signals=signals, warn=quiet)
    np.testing.assert_allclose(record.x, np.stack([np.cos(2 * Y), np.sin(2 * Y), 2 * Y], -1))
    assert record.signals == Signals("time", ("theta",), (), signals.hidden)
    assert record.u is None


def test_parquet(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="needs the extra parquet")
    from pyarrow import parquet

    path = tmp_path / "a.parquet"
    parquet.write_table(pyarrow.table({"t": T, "y": Y, "note": ["text"] * len(T)}), path)
    np.testing.assert_array_equal(read_records([path], warn=quiet)[0].y[:, 0], Y)
    parquet.write_table(pyarrow.table({"t": T, "y": ["text"] * len(T)}), path)
    with pytest.raises(ValueError, match=r"a.parquet: column y must hold numbers"):
        read_records([path])
    path.write_bytes(b"PAR1")
    with pytest.raises(ValueError, match=r"a.parquet: Parquet file size is 4 bytes"):
        read_records([path])


def test_missing_samples_are_nan(tmp_path):
    rows = ["0,1,2,", "0.1,None,2,", "0.2,NaN,n/a,", "0.3,2,1,"]
    signals = Signals(measured=("theta",), hidden=("alpha",))
    (record,) = read_records([csv(tmp_path / "a.csv", rows=rows)], signals=signals, warn=quiet)
    np.testing.assert_array_equal(record.y[:, 0], [1, np.nan, np.nan, 2])
    np.testing.assert_array_equal(record.x[:, 0], [2, 2, np.nan, 1])


BAD_CSV = {
    "short row": (["0,1,2,a", "1,2,a"], "row 2 has 3 cells, the header 4"),
    "no number": (["0,1,2,a", "1,x7,2,a"], "column theta, row 2: 'x7' is no number"),
    "time stands": (["0,1,2,a", "0,2,2,a"], "column time, row 2: time must increase"),
    "no time": (["0,1,2,a", ",2,2,a"], "column time, row 2: a number is missing"),
    "infinite": (["0,1,2,a", "1,inf,2,a"], "column theta, row 2: inf is no sample"),
    "all missing": (["0,,2,a", "1,nan,2,a"], "column theta, row 1: no row holds a number"),
    "one row": (["0,1,2,a"], "t must be two samples at least"),
    "rounding moves": ([f"{k},0.1,2,a" for k in range(99)], "column theta: 0.1 in all rows"),
    "decimal comma": (
        ["0,1,2,a", '1,"2,5",2,a'],
        "column theta, row 2: '2,5' is no number; write decimals with a point",
    ),
    "hidden never moves": (["0,3,2,a", "1,4,2,a"], r"column cos\(alpha\): -0.416147 in all rows"),
}


@pytest.mark.parametrize("case", BAD_CSV)
def test_bad_csv(tmp_path, case):
    rows, message = BAD_CSV[case]
    signals = Signals(measured=("theta",), hidden=("cos(alpha)",))
    with pytest.raises(ValueError, match=f"bad.csv: {message}"):
        read_records([csv(tmp_path / "bad.csv", rows=rows)], signals=signals, warn=quiet)


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("time,theta,beta,note", r"no column alpha; there are time, theta, beta, note \(--hidden\)"),
        ("when,theta,alpha,note", r"no column t; there are .* \(--time\)"),
        ("time,theta,theta,alpha", "more than one column theta"),
        ("", "first row must hold the names"),
    ],
)
def test_bad_header(tmp_path, header, message):
    signals = Signals(measured=("theta",), hidden=("sin(alpha)",))
    with pytest.raises(ValueError, match=message):
        read_records([csv(tmp_path / "bad.csv", header)], signals=signals)


BAD_NPZ = {
    "objects": ({"y": np.array([None] * 200)}, "bad.npz: column y must hold numbers, got object"),
    "transposed": ({"y": np.stack([Y, Y])}, "columns must be of one length; t has 200, y1 has 2 rows$"),
    "rows for columns": ({"t": T[None]}, r"no column t; there are t1, t2, [t0-9, ]* \.\.\. \(--time\)$"),
    "text": ({"y": np.array(["a"] * 200)}, "bad.npz: column y must hold numbers, got <U1"),
    "missing input": ({"u": np.where(T < 5, T, np.nan)}, "bad.npz: column u, row 101: a number is missing"),
}


@pytest.mark.parametrize("case", BAD_NPZ)
def test_bad_npz(tmp_path, case):
    arrays, message = BAD_NPZ[case]
    with pytest.raises(ValueError, match=message):
        read_records([npz(tmp_path / "bad.npz", **arrays)])


def test_what_is_not_asked_for_does_no_harm(tmp_path):
    (record,) = read_records([npz(tmp_path / "a.npz", notes=np.array({"made": "today"}, dtype=object))], warn=quiet)
    np.testing.assert_array_equal(record.t, T)
    (tmp_path / "b.csv").write_text('"t", "y"\n"0", "1"\n"1", "3"\n')  # with spaces before quotes
    np.testing.assert_array_equal(read_records([tmp_path / "b.csv"], warn=quiet)[0].y, [[1.0], [3.0]])


def test_no_record(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK nothing")
    (tmp_path / "a.csv").write_bytes(b"t,y\n\xff\xff")
    (tmp_path / "a.txt").write_text("t y")
    (tmp_path / "folder.csv").mkdir()
    np.save(tmp_path / "b.npy", Y)
    (tmp_path / "b.npy").rename(tmp_path / "b.npz")
    for name, message in {
        "a.npz": "pickle",
        "b.npz": "a single array",
        "a.csv": "'utf-8' codec can't decode byte 0xff",
        "a.txt": "its name must end in .npz, .csv, .parquet",
        "folder.csv": "is a folder",
        "nowhere.csv": "there is no file",
    }.items():
        with pytest.raises(ValueError, match=message) as caught:
            read_records([tmp_path / name])
        assert name in str(caught.value)
    with pytest.raises(ValueError, match="name a file"):
        read_records([])
    for name, message in (("cos(t)", "column t is the time, and cannot be a signal too"), ("exp(y)", "no column exp")):
        with pytest.raises(ValueError, match=message):
            read_records([npz(tmp_path / "c.npz")], signals=Signals(measured=("y", name)))


def test_files_that_differ(tmp_path):
    first = npz(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"a.npz: named twice, which would count each sample twice$"):
        read_records([first, npz(tmp_path / "b.npz"), first])
    with pytest.raises(ValueError, match=r"b.npz: inputs are columns u, but none in .*a.npz"):
        read_records([first, npz(tmp_path / "b.npz", u=Y)])
    with pytest.raises(ValueError, match=r"b.npz: column t: steps of 50 s, but .*other units than seconds"):
        read_records([first, npz(tmp_path / "c.npz"), npz(tmp_path / "b.npz", t=1000 * T)])
    with pytest.warns(UserWarning, match=r"b.npz: column y spreads over 1e\+03 times"):
        read_records([first, npz(tmp_path / "b.npz", y=1000 * Y)])
    with pytest.warns(UserWarning, match=r"b.npz: column y never moves"):
        read_records([first, npz(tmp_path / "b.npz", y=0 * Y)])


def test_a_signal_may_stand_still_in_each_record_but_not_in_all(tmp_path):
    for values, ok in ((range(3), True), ([1, 1, 1], False)):
        paths = [npz(tmp_path / f"{i}.npz", y=np.column_stack([Y, 0 * Y + each])) for i, each in enumerate(values)]
        if ok:
            assert [record.y[0, 1] for record in read_records(paths)] == [0.0, 1.0, 2.0]
            continue
        with pytest.raises(ValueError, match=r"0.npz: column y2: 1 in all rows, and no other file says more"):
            read_records(paths)


def test_wrapped_angles(tmp_path):
    wrapped = np.angle(np.exp(1j * 2 * T))
    with pytest.warns(UserWarning, match=r"column y, row \d+: a jump by a whole turn.*take cos\(y\) and sin\(y\)"):
        read_records([npz(tmp_path / "a.npz", y=wrapped)])
    read_records([npz(tmp_path / "b.npz", y=wrapped)], signals=Signals(measured=("cos(y)", "sin(y)")), warn=quiet)


def test_units_and_numbers_of_a_systems_signals(tmp_path):
    system = Autonomous()
    y = np.sin(T)[:, None] * system.output_range
    read_records([npz(tmp_path / "a.npz", y=y)], system=system, warn=quiet)
    with pytest.raises(ValueError, match=r"b.npz: column y moves by .* 1\.?\d*e\+03 times what .* other units"):
        read_records([npz(tmp_path / "b.npz", y=1000 * y)], system=system)
    with pytest.warns(UserWarning, match=r"b.npz: column y moves by .* 0.001"):
        read_records([npz(tmp_path / "b.npz", y=y / 1000)], system=system)
    steps = r"b.npz: column t: steps of .* s are .* times the dt .* time in seconds"
    with pytest.warns(UserWarning, match=steps):
        read_records([npz(tmp_path / "b.npz", t=1e-4 * T, y=y)], system=system)
    with pytest.raises(ValueError, match=steps):
        read_records([npz(tmp_path / "b.npz", t=1000 * T, y=y)], system=system)
    with pytest.raises(ValueError, match=r"has 1 measured, but the columns are y1, y2; name others by --measured"):
        read_records([npz(tmp_path / "b.npz", y=np.hstack([y, y]))], system=system)


def test_records_in_memory():
    record = Record("a", T, Y[:, None], x=np.stack([Y, Y], -1))
    assert record.signals == Signals("t", ("y1",), (), ("x1", "x2"))
    assert record.duration == pytest.approx(9.95)
    with pytest.raises(ValueError, match=r"y must have shape \(200, n\)"):
        Record("a", T, Y)
    column = Y[:, None]
    for y in (np.ma.masked_array(column, column > 0.5), column + 1j, column.astype(str), None, [[1], [1, 2]]):
        with pytest.raises(ValueError, match=r"a: y (must hold real numbers|holds masked entries)"):
            Record("a", T, y)
    with pytest.raises(ValueError, match=r"y has 1 columns, but measured"):
        Record("a", T, Y[:, None], signals=Signals(measured=("p", "q")))
    with pytest.raises(ValueError, match=r"measured names y twice"):
        Signals(measured=("y", "y"))
    with pytest.raises(ValueError, match=r"hidden must be names of columns"):
        Signals(hidden="alpha")
