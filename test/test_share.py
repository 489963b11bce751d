"""Files of the package are found from anywhere, a user's own file first."""

from __future__ import annotations

from pathlib import Path

import pytest

from iwm_power_manager import share


def test_a_file_of_the_package_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert share.resolve("config/cycles/nycc.csv").is_file()


def test_the_users_own_file_goes_before_that_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "config" / "cycles" / "nycc.csv"
    own.parent.mkdir(parents=True)
    own.touch()
    monkeypatch.chdir(tmp_path)
    assert share.resolve("config/cycles/nycc.csv").samefile(own)


def test_a_file_below_an_ament_prefix_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed = tmp_path / "share" / "iwm_power_manager" / "config" / "only_here.yaml"
    installed.parent.mkdir(parents=True)
    installed.touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert share.resolve("config/only_here.yaml") == installed


@pytest.mark.parametrize("path", ["/nowhere/at/all.yaml", "nowhere/at/all.yaml"])
def test_a_path_that_is_nowhere_comes_back_as_given(path: str) -> None:
    assert share.resolve(path) == Path(path)
