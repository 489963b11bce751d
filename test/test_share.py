# SPDX-License-Identifier: Apache-2.0
"""Files of the package are found from anywhere, a user's own file first."""

from __future__ import annotations

from pathlib import Path

import pytest

from iwm_power_manager import share
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import read_bytes


def test_a_file_of_the_package_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert share.resolve("config/cycles/nycc.csv").is_file()


@pytest.mark.parametrize("name", ["README.md", "examples/your_car/my_car.yaml", "runs/mine.csv"])
def test_nothing_else_of_a_checkout_stands_in_for_a_file_that_is_missing(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkout, work = tmp_path / "checkout", tmp_path / "work"
    work.mkdir()
    (checkout / name).parent.mkdir(parents=True)
    (checkout / name).touch()
    monkeypatch.setattr(share, "roots", lambda: [checkout])
    monkeypatch.chdir(work)
    assert share.resolve(name) == Path(name)


def test_the_users_own_file_goes_before_that_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "config" / "cycles" / "nycc.csv"
    own.parent.mkdir(parents=True)
    own.touch()
    monkeypatch.chdir(tmp_path)
    assert share.resolve("config/cycles/nycc.csv").samefile(own)


def test_a_folder_hides_no_file_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "nycc").mkdir()
    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path)
    assert share.resolve("nycc").name == "nycc.csv"
    assert share.resolve("mine") == Path("mine")


def test_a_file_below_an_ament_prefix_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed = tmp_path / "share" / "iwm_power_manager" / "config" / "only_here.yaml"
    installed.parent.mkdir(parents=True)
    installed.touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert share.resolve("config/only_here.yaml") == installed


@pytest.mark.parametrize("path", ["/nowhere/at/all.yaml", "nowhere/at/all.yaml"])
def test_a_path_that_is_nowhere_comes_back_as_given(path: str) -> None:
    assert share.resolve(path) == Path(path)


@pytest.mark.parametrize(
    ("given", "meant"),
    [("nyc", "nycc"), ("NYCC", "nycc"), ("jalalmab_2015", "jalalmaab_2015"), ("my_car.yml", "my_car.yaml")],
)
def test_a_name_that_is_spelled_wrong_is_answered_with_what_was_meant(
    given: str, meant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_car.yaml").touch()
    with pytest.raises(
        ConfigError, match=rf"^{given}: cannot be read: No such file or directory; did you mean.*{meant}"
    ):
        share.resolve(given)


@pytest.mark.parametrize("name", ["nycc", "nycc.csv"])
def test_a_file_of_the_package_is_found_by_its_name_alone(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert share.resolve(name) == share.share_path("config/cycles/nycc.csv")


def test_a_name_that_fits_several_files_is_refused_with_all_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("grids", "vehicles"):
        (tmp_path / "config" / folder).mkdir(parents=True)
        (tmp_path / "config" / folder / "twin.yaml").touch()
    monkeypatch.setattr(share, "roots", lambda: [tmp_path])
    with pytest.raises(ConfigError, match=r"config/grids/twin\.yaml, config/vehicles/twin\.yaml"):
        share.resolve("twin")


def test_a_missing_file_of_the_package_is_reported_with_the_folders_searched() -> None:
    with pytest.raises(ConfigError, match=r"config/nowhere\.yaml: no such file in the package; searched /"):
        share.share_path("config/nowhere.yaml")


@pytest.mark.parametrize("library", ["lib/python3.12/site-packages", "local/lib/python3.12/dist-packages"])
def test_the_files_of_an_installation_are_found_without_any_variable(
    library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = tmp_path / "share" / "iwm_power_manager"
    shared.mkdir(parents=True)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.setattr(share, "__file__", str(tmp_path / library / "iwm_power_manager" / "share.py"))
    assert share.roots()[0] == shared


@pytest.mark.parametrize("name", ["x" * 300, "a\0b", "~nobody-at-all/car.yaml", "config/" + "x" * 300])
def test_a_name_that_no_file_can_have_comes_back_for_whoever_opens_it(name: str) -> None:
    assert share.resolve(name) == Path(name)
    with pytest.raises(ConfigError, match="cannot be read: "):
        read_bytes(share.resolve(name))


def test_a_link_to_nowhere_is_not_answered_with_its_own_name(tmp_path: Path) -> None:
    (tmp_path / "my_van.yaml").symlink_to("nowhere")
    with pytest.raises(ConfigError, match=r"No such file or directory$"):
        read_bytes(tmp_path / "my_van.yaml")


def test_a_file_that_is_not_there_is_answered_with_its_neighbours_of_nearly_that_name(tmp_path: Path) -> None:
    for neighbour in ("my_van.yaml", "my_van1.log", "my_van2.log", "my_vann"):
        (tmp_path / neighbour).touch()
    with pytest.raises(ConfigError, match=rf"No such file or directory; did you mean {tmp_path}/my_van\.yaml\?$"):
        read_bytes(tmp_path / "my_vann.yaml")
    with pytest.raises(ConfigError, match=r"No such file or directory$"):
        read_bytes(tmp_path / "else.yaml")
