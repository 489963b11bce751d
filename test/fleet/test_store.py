# SPDX-License-Identifier: Apache-2.0
"""A study's folder: what is there is whole, can grow, and takes nothing that cannot be compared."""

import json

import pytest

from iwm_power_manager.errors import ConfigError
from iwm_sim.fleet.run import runner
from iwm_sim.fleet.store import Store
from iwm_sim.fleet.task import Drive, fingerprint


def test_a_stopped_study_goes_on_with_what_is_missing_and_gives_the_same_rows(fleet, serial, tmp_path):
    store = Store(tmp_path / "study")
    with runner(store, fleet.files, None, 1, 0.0) as running:
        assert running.run(Drive, fleet.drives[3:7])[:3] == (4, 0, 4)
        assert running.run(Drive, fleet.drives)[:3] == (10, 4, 6)
        assert running.run(Drive, fleet.drives)[:3] == (10, 10, 0)
    assert store.table(Drive).equals(serial.table(Drive))


def test_each_part_says_what_it_took(serial):
    import pyarrow.parquet as pq

    parts = list((serial.folder / "rows").iterdir())
    assert len(parts) == 10
    metadata = pq.read_schema(parts[0]).metadata
    assert float(metadata[b"cpu_s"]) > 0.0
    assert b":" in metadata[b"worker"]


def test_a_study_takes_no_rows_of_another_code_or_another_file(fleet, hill, tmp_path):
    store = Store(tmp_path)
    store.begin(fingerprint(), fleet.files)
    with pytest.raises(ConfigError, match=r"was begun with something else: sources new instead of .*another --output"):
        store.begin(fingerprint() | {"sources": "new"}, fleet.files)
    content = json.loads((tmp_path / "fleet.json").read_text())
    content["files"][str(hill)] = "0"
    (tmp_path / "fleet.json").write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=r"hill.csv was another file"):
        store.begin(fingerprint(), fleet.files)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"fingerprint": 1, "files": {}}'])
def test_a_folder_of_something_else_is_refused(text, tmp_path):
    (tmp_path / "fleet.json").write_text(text)
    with pytest.raises(ConfigError, match="is not what a fleet study writes"):
        Store(tmp_path).begun()


def test_a_damaged_part_is_named(serial, tmp_path):
    store = Store(tmp_path)
    store.begin(fingerprint(), [])
    source = next((serial.folder / "rows").iterdir())
    (tmp_path / "rows" / source.name).write_bytes(source.read_bytes()[:-100])
    with pytest.raises(ConfigError, match=rf"{source.name}: cannot be read: .*delete it"):
        store.table(Drive)
