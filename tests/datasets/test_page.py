"""The page of a dataset: one file that fetches nothing, runs nothing and shows each episode."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from fixtures.episodes import INFO, JOINTS, episode
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.datasets import Dataset, DatasetInfo, Feature
from strands_robots.datasets.episodes import DatasetEpisode
from strands_robots.datasets.layout import data_file
from strands_robots.datasets.page import dataset_page
from strands_robots.utils import ValidationError

HOSTILE = '<script>alert(1)</script> & "go"'


class Elements(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.open: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with Dataset(tmp_path / "set", INFO) as dataset:
        dataset.save(episode(dataset, task=HOSTILE))
        dataset.save(episode(dataset))
    return tmp_path / "set"


def test_page_is_one_file_without_scripts_and_addresses(folder: Path) -> None:
    page = dataset_page(folder)
    found = Elements(page)
    assert not found.open, "every element is closed"
    assert "script" not in found.tags
    assert found.links
    assert all(link.startswith("data:image/jpeg;base64,") for link in found.links)
    assert "http" not in re.sub(r"http-equiv", "", page)
    assert "&lt;script&gt;" in page


def test_page_draws_each_joint_and_the_pictures_of_the_episodes_that_are_asked_for(folder: Path) -> None:
    page = Elements(dataset_page(folder, [1]))
    assert page.tags.count("svg") == len(JOINTS)
    assert 1 <= page.tags.count("img") <= 8
    both = Elements(dataset_page(folder))
    assert both.tags.count("svg") == 2 * len(JOINTS)
    with pytest.raises(ValidationError, match="episode"):
        dataset_page(folder, [2])


def test_page_marks_stops_and_the_frames_in_which_a_person_led(tmp_path: Path) -> None:
    features = {name: Feature("float32", (2,), ("pan", "lift")) for name in ("observation.state", "action")}
    features |= {"stop": Feature("int64"), "intervention": Feature("bool"), "next.success": Feature("bool")}
    features["actor"] = Feature("int64")
    rows = np.arange(60, dtype=np.float32).reshape(30, 2)
    columns = {"observation.state": rows, "action": rows + 1, "next.success": np.zeros(30, dtype=bool)}
    columns["stop"] = np.where(np.arange(30) == 29, 2, 0).astype(np.int64)
    columns["intervention"] = (np.arange(30) >= 10) & (np.arange(30) < 20)
    columns["actor"] = np.where(columns["intervention"], 2, 1).astype(np.int64)
    with Dataset(tmp_path / "set", DatasetInfo(30, features, "arm")) as dataset:
        dataset.save(DatasetEpisode("reach", columns))
    page = dataset_page(tmp_path / "set")
    assert page.count('<rect class="led"') == page.count('<polyline class="stopped"') == 2
    assert (page.count('<rect class="by1"'), page.count('<rect class="by2"')) == (4, 2), "who acted, below each plot"
    assert "</span>&nbsp;policy, <span" in page
    assert "emergency stop</td>" in page
    assert "33 %</td>" in page


def test_episode_that_cannot_be_read_is_named_and_the_others_are_shown(folder: Path) -> None:
    (folder / data_file(0)).write_bytes(b"cut off")
    page = dataset_page(folder)
    assert 'class="wrong"' in page
    assert "cannot be read" in page
    assert Elements(page).tags.count("svg") == len(JOINTS)


def test_command_writes_the_page_beside_the_dataset(folder: Path) -> None:
    done = CliRunner().invoke(build("dataset"), ["dataset", "show", str(folder), "--json"])
    assert done.exit_code == 0, done.output
    assert (folder.parent / "set.html").read_text().startswith("<!doctype html>")
    missing = CliRunner().invoke(build("dataset"), ["dataset", "show", str(folder / "none"), "--json"])
    assert (missing.exit_code != 0, "DIR must be a folder" in missing.output) == (True, True)


def test_page_of_a_folder_without_a_name_needs_a_file() -> None:
    done = CliRunner().invoke(build("dataset"), ["dataset", "show", "/", "--json"])
    assert (done.exit_code, "--out must be given" in done.output) == (2, True)
