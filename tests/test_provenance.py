from __future__ import annotations

import subprocess

import pytest

from stlc import provenance
from stlc.jsontext import plain
from stlc.provenance import git_state, hardware, sha256, versions


def test_hashes_of_texts_are_those_of_their_bytes():
    assert sha256("") == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    assert sha256("é") == sha256("é".encode())


def test_versions_and_machine_are_data():
    assert {"python", "numpy"} <= set(versions())
    assert hardware()["cores"] >= 1
    assert plain({**versions(), **hardware()})


@pytest.fixture
def tree(tmp_path):
    def git(*arguments):
        identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        subprocess.run(["git", *identity, *arguments], cwd=tmp_path, check=True, capture_output=True)

    git("init", "-q")
    (tmp_path / "a").write_text("1")
    git("add", "a")
    git("commit", "-qm", "first")
    return tmp_path


def test_the_state_of_a_tree(tree):
    clean = git_state(tree)
    assert len(clean["commit"]) == 40
    assert clean["dirty"] is False
    (tree / "b").write_text("untracked files do not change what was run")
    assert git_state(tree)["dirty"] is False
    (tree / "a").write_text("2")
    assert git_state(tree) == {"commit": clean["commit"], "dirty": True}


def test_outside_of_git_there_is_no_state(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path))
    assert git_state(tmp_path) is None


def test_without_git_there_is_no_state(monkeypatch, tree):
    monkeypatch.setenv("PATH", "")
    assert git_state(tree) is None


def test_packages_that_are_not_installed_are_left_out(monkeypatch):
    monkeypatch.setattr(provenance, "PACKAGES", ("numpy", "surely-not-installed"))
    provenance.versions.cache_clear()
    assert set(provenance.versions()) == {"python", "numpy"}
    provenance.versions.cache_clear()
