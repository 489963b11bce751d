# SPDX-License-Identifier: Apache-2.0
"""A study's folder: how it was begun, its policies, and rows in Parquet, a part for each batch as it came.

    fleet.json                 fingerprint of code and processor, hashes of the files it names
    policies/KEY.npz           policies by the key of the task that solved them
    rows/drive-HASH.parquet    rows of some tasks (drive, solve, road), with what the batch took in the file's metadata

Every file is written whole or not at all, a part after the policies of its rows; so what is there is done, whenever
the study was stopped. Later tasks may be added to a folder, but no others: rows of two codes, processors or car files
would stand beside each other as if they could be compared.
"""

from __future__ import annotations

import json
import os
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import atomic_write, make_folder, read_text, sha256_of
from iwm_power_manager.share import resolve
from iwm_sim.fleet.task import COLUMNS, Batch, Given, differences, key_of

#: No part holds more than a batch; this bounds what a stranger's file may be.
_TYPES = {str: pa.string(), float: pa.float64(), bool: pa.bool_(), int: pa.int64()}


def name_of(kind: type[Any]) -> str:
    """What the parts of a kind of task are called."""
    return kind.__name__.lower()


def schema_of(kind: type[Any]) -> pa.Schema:
    """Columns of a kind's rows."""
    hints = {name: hint for row in COLUMNS[kind] for name, hint in typing.get_type_hints(row).items()}
    return pa.schema([(name, _TYPES[(typing.get_args(hint) or (hint,))[0]]) for name, hint in hints.items()])


class Store:
    """The folder of a study.

    Raises
    ------
    ConfigError
        It cannot be made, or a part cannot be read.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self.policies = self.folder / "policies"
        self._rows = self.folder / "rows"

    def begin(self, fingerprint: Mapping[str, str], files: Sequence[str]) -> Given:
        """Begin a study, or go on with one: the same code, processor and files.

        Raises
        ------
        ConfigError
            They are not the same; it says which.
        """
        path = self.folder / "fleet.json"
        hashes = {name: sha256_of(resolve(name)) for name in files}
        begun = self.begun() if os.path.exists(path) else {"fingerprint": dict(fingerprint), "files": {}}
        problem = differences(begun["fingerprint"], fingerprint)
        changed = [name for name in files if begun["files"].get(name, hashes[name]) != hashes[name]]
        problem = problem or ", ".join(f"{name} was another file" for name in changed)
        if problem:
            raise ConfigError(self.folder, "", f"was begun with something else: {problem}", "another --output")
        content = begun | {"files": begun["files"] | hashes}
        for folder in (self.policies, self._rows):
            make_folder(folder)
        atomic_write(path, (json.dumps(content, indent=1) + "\n").encode())
        return Given(str(self.policies.absolute()), content["fingerprint"], hashes)

    def begun(self) -> dict[str, Any]:
        """What the study was begun with."""
        path = self.folder / "fleet.json"
        try:
            content = json.loads(read_text(path))
            known = isinstance(content["fingerprint"], dict) and isinstance(content["files"], dict)
        except (ValueError, KeyError, TypeError):
            known = False
        if not known:
            raise ConfigError(path, "", "is not what a fleet study writes", "a folder that fleet has made")
        return dict(content)

    def missing[T](self, kind: type[Any], tasks: Sequence[T]) -> list[T]:
        """The tasks that have no rows yet; their order stays."""
        done = set(self.table(kind, ["key"])["key"].to_pylist())
        return [task for task in tasks if key_of(task) not in done]

    def add(self, kind: type[Any], batch: Batch) -> None:
        """Write what a batch made."""
        for made in batch.made:
            for name, content in made.policies.items():
                atomic_write(self.policies / name, content)
        table = pa.Table.from_pylist([row for made in batch.made for row in made.rows], schema_of(kind))
        took = {"cpu_s": f"{batch.cpu_s:.6f}", "wall_s": f"{batch.wall_s:.6f}", "worker": batch.worker}
        stream = pa.BufferOutputStream()
        pq.write_table(table.replace_schema_metadata(took), stream)
        atomic_write(self._rows / f"{name_of(kind)}-{key_of(batch.keys)}.parquet", stream.getvalue().to_pybytes())

    def table(self, kind: type[Any], columns: list[str] | None = None) -> pa.Table:
        """All rows of a kind, in the order of their keys, whoever made them when; a task's own rows stay in order."""
        schema = schema_of(kind)
        parts = []
        for path in sorted(self._rows.glob(f"{name_of(kind)}-*.parquet")):
            try:
                parts.append(pq.read_table(path, columns=columns or schema.names).replace_schema_metadata())
            except (OSError, pa.ArrowException, KeyError) as error:
                reason = " ".join(str(error).split())
                raise ConfigError(path, "", f"cannot be read: {reason}", "delete it, and run the study again") from None
        empty = pa.schema([field for field in schema if columns is None or field.name in columns]).empty_table()
        table = pa.concat_tables([empty, *parts])
        number = pa.array(range(table.num_rows))
        order = table.append_column("number", number).sort_by([("key", "ascending"), ("number", "ascending")])
        return order.drop_columns(["number"])
