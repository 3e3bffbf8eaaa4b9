"""Optional packages: the table of extras, and the error where one is missing."""

from __future__ import annotations

import ast
import json
import pickle
import re
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.sources import tree

from stlc import extras
from stlc.diagnostics import MissingError
from stlc.extras import CPU_BUILD, EXTRAS, NotInstalledError, explained, installation, needed, not_installed

ROOT = Path(__file__).resolve().parent.parent


def test_the_table_is_that_of_the_project():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra in declared.keys() - {"all", "dev", "docs", "peers"}:
        names = [re.split(r"[<>=~; ]", entry)[0] for entry in declared[extra]]
        assert EXTRAS[extra] == tuple(name for name in names if not name.startswith("stlc[")), extra
    assert EXTRAS.keys() <= declared.keys()


def test_what_is_imported_is_declared():
    """Packages that `needed` asks for may belong to no extra: the error names them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {re.split(r"[<>=~; ]", entry)[0] for entry in project["dependencies"]}
    declared |= {name for brought in EXTRAS.values() for name in brought} | {"stlc"}
    other = {"yaml": "pyyaml", "pybullet_utils": "pybullet"} | extras._PACKAGES
    for path in (ROOT / "stlc").rglob("*.py"):
        for node in ast.walk(tree(path)):
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            for name in {each.split(".")[0] for each in names} - sys.stdlib_module_names:
                assert other.get(name, name).replace("_", "-") in declared, (path, name)


def test_torch_is_asked_for_with_the_build_for_processors():
    (finding,) = not_installed("torch").diagnostics
    assert finding.code == "R301"
    assert finding.message == "this needs `torch` of the extra `train`, which is not installed"
    assert finding.help == (CPU_BUILD, installation("train"))


def test_several_packages_and_packages_of_no_extra():
    (both,) = not_installed("matplotlib", "pillow", need="pictures need").diagnostics
    assert both.message.startswith("pictures need `matplotlib` and `pillow` of the extra `plot`, which")
    (alone,) = not_installed("scipy").diagnostics
    assert alone.help == ("pip install scipy",)


def test_a_missing_package_is_an_error_of_the_import_too():
    error = not_installed("torch")
    assert isinstance(error, MissingError)
    assert isinstance(error, ImportError)
    assert error.exit_code == 5
    assert pickle.loads(pickle.dumps(error)).diagnostics == error.diagnostics


@pytest.mark.parametrize(
    ("module", "package"),
    [
        ("PIL.Image", "pillow"),
        ("google.protobuf", "protobuf"),
        ("lsprotocol", "pygls"),
        ("stable_baselines3", "stable-baselines3"),
        ("pytorch_kinematics", "pytorch-kinematics"),
    ],
)
def test_a_module_leads_to_its_package(module, package, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(NotInstalledError, match=f"`{package}`"):
        needed(module)


def test_an_import_within_stlc_is_explained(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(NotInstalledError, match="`onnx` of the extra `onnx`"), explained():
        import onnx  # noqa: F401
    with pytest.raises(ModuleNotFoundError, match="No module named 'surely_absent'"), explained():
        import surely_absent  # noqa: F401


# ------------------------------------------------------------------------- the command that installs an extra


class Record:
    """Metadata of an installed package."""

    def __init__(self, **record: object) -> None:
        self.text = json.dumps(record) if record else None

    def read_text(self, name: str) -> str | None:
        assert name == "direct_url.json"
        return self.text


GIT = {"vcs": "git", "commit_id": "abc123"}


@pytest.mark.parametrize(
    ("record", "command"),
    [
        (Record(), "pip install 'stlc[plot]'"),
        (Record(url="https://a.b/stlc", vcs_info=GIT), "'stlc[plot] @ git+https://a.b/stlc@abc123'"),
        (Record(url="file:///a/stlc.whl", archive_info={}), "'stlc[plot] @ file:///a/stlc.whl'"),
        (Record(url="file:///a b/'$(x)'", dir_info={}), "'stlc[plot] @ file:///a b/'\"'\"'$(x)'\"'\"''"),
    ],
)
def test_an_extra_comes_from_where_stlc_came_from(record, command, monkeypatch, tmp_path):
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "stlc/extras.py"))
    monkeypatch.setattr("importlib.metadata.distributions", lambda **_: iter([record]))
    assert installation("plot").endswith(command)
    monkeypatch.setattr(extras, "os", SimpleNamespace(name="nt"))
    assert installation("plot").startswith('pip install "stlc[plot]')


def test_an_extra_of_a_checkout():
    assert installation("plot") == f"pip install -e '{ROOT}[plot]'"


def test_an_extra_of_a_copy_without_a_record(monkeypatch, tmp_path):
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "stlc/extras.py"))
    monkeypatch.setattr("importlib.metadata.distributions", lambda **_: iter([]))
    assert installation("plot") == "pip install 'stlc[plot] @ git+URL'"
