import numpy as np
import pytest
from linear_system import Oscillator

from training.records import Record, Signals, read_records

T = np.arange(200) * 0.05
Y = np.sin(T)
WANTED = Signals(measured=("theta",), hidden=("cos(alpha)",))


def quiet(text):
    raise AssertionError(text)


def npz(path, **arrays):
    np.savez(path, **{"t": T, "y": Y[:, None], **arrays})
    return path


def csv(path, header="time,theta,alpha,note", rows=None):
    rows = [f"{t},{y},{2 * y},kept" for t, y in zip(T, Y)] if rows is None else rows
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_arrays(tmp_path):
    u, x = np.cos(T), np.stack([Y, np.cos(T)], -1)
    for given in (u, u[:-1]):  # there may be no input after the last sample
        path = npz(tmp_path / "a.npz", u=given, x=x, notes=np.array("today"), more=np.array({}, dtype=object))
        (record,) = read_records([path], warn=quiet)
        assert record.signals == Signals("t", ("y",), ("u",), ("x1", "x2"))
        for found, expected in ((record.t, T), (record.y[:, 0], Y), (record.u[:-1, 0], u[:-1]), (record.x, x)):
            np.testing.assert_array_equal(found, expected)
        assert record.u[-1, 0] == given[-1]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_by_names(tmp_path, separator):
    path = csv(tmp_path / "a.csv")
    path.write_text("\ufeff" + path.read_text().replace(",", separator) + "\n\n", encoding="utf-8")
    signals = Signals(measured=("theta",), hidden=("cos(alpha)", "sin(alpha)", "alpha"))
    (record,) = read_records([path], signals=signals, warn=quiet)
    np.testing.assert_allclose(record.x, np.stack([np.cos(2 * Y), np.sin(2 * Y), 2 * Y], -1))
    assert record.signals == Signals("time", ("theta",), (), signals.hidden)
    assert record.u is None


@pytest.mark.parametrize(
    "text",
    [
        '"time, in s";"y, in mm"\n0;1\n1;3\n',
        '"time, in s", "y, in mm"\n"0", "1"\n"1", "3"\n',  # with spaces before quotes
        '"time, in s"\t"y, in mm"\t; x\r\r0\t1\t7\r1\t3\t7\r',
        '"time, in s","y, in mm"\n2024-05-01T23:59:59.5Z,1\n2024-05-02T00:00:00.5Z,3\n',
    ],
)
def test_headers_and_times(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    signals = Signals("time, in s", ("y, in mm",))
    (record,) = read_records([tmp_path / "a.csv"], signals=signals, warn=quiet)
    assert (record.t.tolist(), record.y[:, 0].tolist()) == ([0.0, 1.0], [1.0, 3.0])


def test_parquet(tmp_path):
    pytest.importorskip("pyarrow", reason="needs the extra parquet")
    import pandas as pd

    path, table = tmp_path / "a.parquet", pd.DataFrame({"t": T, "y": Y, "u": T > 1, "note": "text"})
    dates = table.drop(columns="t").set_index(pd.Timestamp("2024-05-01") + pd.to_timedelta(T, unit="s"))
    for frame in (table, dates):
        frame.to_parquet(path)
        (record,) = read_records([path], warn=quiet)
        np.testing.assert_allclose(record.t, T, atol=1e-9)
        np.testing.assert_array_equal((record.y[:, 0], record.u[:, 0]), (Y, T > 1))
    path.write_bytes(b"PAR1")
    with pytest.raises(ValueError, match=r"a.parquet: .*Parquet file size is 4 bytes"):
        read_records([path])


def test_missing_samples_are_nan(tmp_path):
    rows = ["0,1,2,", "0.1,None,2,", "0.2,NaN,n/a,", "0.3,2,1,"]
    signals = Signals(measured=("theta",), hidden=("alpha",))
    (record,) = read_records([csv(tmp_path / "a.csv", rows=rows)], signals=signals, warn=quiet)
    np.testing.assert_array_equal(record.y[:, 0], [1, np.nan, np.nan, 2])
    np.testing.assert_array_equal(record.x[:, 0], [2, 2, np.nan, 1])


BAD_CSV = {
    "short row": (["0,1,2,a", "1,2,a"], "row 2 has 3 cells, the header 4"),
    "no number": (["0,1,2,a", "1,x7,2,a"], "column theta, row 2: 'x7' is not a number"),
    "time stands": (["0,1,2,a", "0,2,2,a"], "column time, row 2: time must increase"),
    "no time": (["0,1,2,a", ",2,2,a"], "column time, row 2: a number is missing"),
    "all missing": (["0,,2,a", "1,nan,2,a"], "column theta, row 1: no row holds a number"),
    "no rows": ([], "column time has no rows"),
    "a bad date": (["2024-05-01,1,2,a", "noon,2,2,a"], "column time, row 2: 'noon' is not a date in ISO 8601"),
    "a date is missing": (["2024-05-01,1,2,a", ",2,2,a"], "column time, row 2: a number is missing"),
    "one row": (["0,1,2,a"], "t must hold at least two samples"),
    "rounding moves": ([f"{k},0.1,2,a" for k in range(99)], "column theta: 0.1 in all rows"),
    "decimal comma": (['0,"1",2,a', '1,"2,5",2,a'], "theta, row 2: '2,5' is not a number; write decimals with a point"),
    "hidden never moves": (["0,3,2,a", "1,4,2,a"], r"column cos\(alpha\): -0.416147 in all rows"),
}


@pytest.mark.parametrize("case", BAD_CSV)
def test_bad_csv(tmp_path, case):
    rows, message = BAD_CSV[case]
    with pytest.raises(ValueError, match=f"bad.csv: .*{message}"):
        read_records([csv(tmp_path / "bad.csv", rows=rows)], signals=WANTED, warn=quiet)


def test_bad_header(tmp_path):
    for header, message in (
        ("time,theta,beta,note", r"no column alpha; there are .*'beta', 'note'\) \(--hidden\)"),
        ("when,theta,alpha,note", r"no column t; there are .* \(--time\)"),
        ("time,theta,theta,alpha", "more than one column theta"),
        ("", "first row must hold the names"),
        ("# a logger, 3", r"row 1 has 4 cells, the header 2: \['# a logger', '3'\]"),
    ):
        with pytest.raises(ValueError, match=message):
            read_records([csv(tmp_path / "bad.csv", header)], signals=WANTED)


BAD_NPZ = {
    "objects": ({"y": np.array([None] * 200)}, r"bad.npz: no column y; there are \('t',\)"),
    "transposed": ({"y": np.stack([Y, Y])}, "columns must be of one length; t has 200, y1 has 2 rows$"),
    "rows for columns": ({"t": T[None]}, r"no column t; there are \('t1', 't2', .* … .* \(--time\)$"),
    "missing input": ({"u": np.where(T < 5, T, np.nan)}, "bad.npz: column u, row 101: a number is missing"),
}


@pytest.mark.parametrize("case", BAD_NPZ)
def test_bad_npz(tmp_path, case):
    arrays, message = BAD_NPZ[case]
    with pytest.raises(ValueError, match=message):
        read_records([npz(tmp_path / "bad.npz", **arrays)])


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
        "a.csv": "a.csv is not in UTF-8",
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
            read_records([npz(tmp_path / "c.npz")], signals=Signals("", ("y", name)))


def test_files_that_differ(tmp_path):
    first = npz(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"a.npz: named twice, which would count each sample twice$"):
        read_records([first, npz(tmp_path / "b.npz"), first])
    with pytest.raises(ValueError, match=r"b.npz: inputs are columns u, but none in .*a.npz"):
        read_records([first, npz(tmp_path / "b.npz", u=Y)])


def test_a_signal_may_stand_still_in_each_record_but_not_in_all(tmp_path):
    moving, still = (
        [npz(tmp_path / f"{i}{j}.npz", y=np.column_stack([Y, 0 * Y + each])) for j, each in enumerate(values)]
        for i, values in enumerate((range(3), [1, 1, 1]))
    )
    assert [record.y[0, 1] for record in read_records(moving)] == [0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match=r"10.npz: column y2: 1 in all rows and all files"):
        read_records(still)


def test_wrapped_angles_and_marks_of_missing_samples(tmp_path):
    wrapped = np.angle(np.exp(1j * 2 * T))
    with pytest.warns(UserWarning, match=r"column y, row \d+: a jump by a whole turn.*take cos\(y\) and sin\(y\)"):
        read_records([npz(tmp_path / "a.npz", y=wrapped)])
    read_records([npz(tmp_path / "b.npz", y=wrapped)], signals=Signals(measured=("cos(y)", "sin(y)")), warn=quiet)
    with pytest.warns(UserWarning, match=r"column y, row 3: -999 is far from all other values, -1 to 1.*missing"):
        read_records([npz(tmp_path / "a.npz", y=np.where(np.arange(200) % 50 == 2, -999, Y))])


def test_records_of_a_systems_signals(tmp_path):
    system, two = Oscillator(), np.stack([Y, Y], -1)
    with pytest.warns(UserWarning, match=r"b.npz: no column of inputs; they are assumed to be zero"):
        read_records([npz(tmp_path / "b.npz")], system=system)
    with pytest.raises(ValueError, match=r"the measured columns are y1, y2, but \w+ has 1; name other columns by"):
        read_records([npz(tmp_path / "b.npz", y=two)], system=system)


def test_records_in_memory():
    column = Y[:, None]
    assert Record("a", T, column, x=np.stack([Y, Y], -1)).signals == Signals("t", ("y1",), (), ("x1", "x2"))
    for y in (np.ma.masked_array(column, column > 0.5), column + 1j, column.astype(str), None, [[1], [1, 2]]):
        with pytest.raises(ValueError, match=r"a: y (must hold real numbers|holds masked entries)"):
            Record("a", T, y)
    for y, names, message in (
        (Y, (), r"y must have shape \(200, n\)"),
        (column, ("p", "q"), "y has 1 columns, but measured"),
        (column, ("y", "y"), "names y twice"),
        (column, "alpha", "must be names of columns"),
    ):
        with pytest.raises(ValueError, match=message):
            Record("a", T, y, signals=Signals("t", names))
