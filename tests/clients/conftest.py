"""The table of clients that ran: a row for each test, kept from one virtual environment to the next."""

import json
from importlib.metadata import version
from pathlib import Path

import pytest

OUT = Path("runs/clients")
NAMES = ("client", "version", "ran", "steps", "result", "gymnasium")


@pytest.fixture
def row(record_property):
    """A function that records the row of a client: its name, its version, the task that ran and its number of steps."""

    def record(client, its_version, ran, steps=""):
        row = {"client": client, "version": its_version, "ran": ran, "steps": steps, "gymnasium": version("gymnasium")}
        for name, value in row.items():
            record_property(name, value)

    return record


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    row = dict(report.user_properties)
    if call.when == "call" and item.get_closest_marker("clients"):
        if report.passed:
            result = "ok"
        elif report.skipped:
            result = f"not run: {report.longrepr[2].removeprefix('Skipped: ')}"
        else:
            result = f"failed: {str(call.excinfo.value).splitlines()[0] if str(call.excinfo.value) else call.excinfo}"
        if row:  # a skipped client, of another virtual environment, records none
            _keep(item.nodeid, {**row, "result": result})
    return report


def _keep(name, row):
    kept = OUT / "rows.json"
    OUT.mkdir(parents=True, exist_ok=True)
    rows = json.loads(kept.read_text()) if kept.exists() else {}
    rows[name] = row
    kept.write_text(json.dumps(rows, indent=1))
    lines = ["| " + " | ".join(NAMES) + " |", "|" + "---|" * len(NAMES)]
    for _, found in sorted(rows.items()):
        lines.append("| " + " | ".join(str(found.get(name, "")).replace("|", "\\|") for name in NAMES) + " |")
    (OUT / "table.md").write_text("\n".join(lines) + "\n")
