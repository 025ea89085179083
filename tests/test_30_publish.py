"""publish: a folder is whole or absent, and a key changes with everything that a result depends on."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tscorr import publish
from tscorr.errors import InputError, OutputError

ABC = {
    "blake3": "6437b3ac38465133ffb63b75273a8db548c558465d79db03fd359c6cd5bd9d85",
    "sha256": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
}
"""hashes of the letters abc, as published with the algorithms"""


def published(target, content="new", key="k"):
    """A published folder with two files."""
    with publish.Publication(target) as publication:
        (publication.folder / "a.txt").write_text(content)
        (publication.folder / "b.txt").write_text("b")
        publication.commit({"key": key, "products": ["corrected", "flags"]})
    return target


def leftovers(folder):
    """Hidden files and folders, which nobody should find after a run."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("algorithm", ABC)
def test_a_committed_folder_has_its_files_and_a_manifest_of_their_hashes(tmp_path, algorithm):
    target = tmp_path / "out" / "scene"
    with publish.Publication(target, algorithm=algorithm) as publication:
        (publication.folder / "a.txt").write_text("abc")
        publication.commit({"key": "k"})
    manifest = json.loads((target / "manifest.json").read_text())
    assert manifest["key"] == "k"
    assert manifest["outputs"] == {"a.txt": {algorithm: ABC[algorithm], "bytes": 3}}
    assert leftovers(tmp_path / "out") == []
    assert publish.damaged(target) == []
    (target / "a.txt").write_text("abd")
    assert publish.damaged(target) == [f"{target / 'a.txt'} has changed since it was published"]


def test_a_file_whose_hash_nobody_here_knows_is_not_called_whole(tmp_path, monkeypatch):
    target = published(tmp_path / "scene")
    monkeypatch.setattr(publish, "HASHES", {"sha256": hashlib.sha256})
    problems = publish.damaged(target)
    assert problems[0] == f"{target / 'a.txt'} has no hash that this version of tscorr knows: blake3, bytes"


def test_files_that_are_hashed_early_have_the_same_entries(tmp_path):
    with publish.Publication(tmp_path / "out", algorithm="sha256") as publication:
        (publication.folder / "a.txt").write_bytes(b"a" * 3_000_000)
        publication.hash_early(publication.folder / "a.txt")
        (publication.folder / "b.txt").write_bytes(b"b")
        publication.commit({})
    outputs = json.loads((tmp_path / "out" / publish.MANIFEST).read_text())["outputs"]
    assert outputs["a.txt"]["sha256"] == hashlib.sha256(b"a" * 3_000_000).hexdigest()
    assert outputs["b.txt"]["sha256"] == hashlib.sha256(b"b").hexdigest()
    assert publish.damaged(tmp_path / "out") == []


def test_inputs_are_hashed_beside_other_work(tmp_path):
    paths = [tmp_path / name for name in "ab"]
    for path in paths:
        path.write_bytes(path.name.encode() * 3_000_000)
    with publish.EarlyHashes(paths, algorithm="sha256") as hashes:
        assert hashes.entries() == {
            str(path): {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()} for path in paths
        }


def test_an_input_that_is_gone_is_an_error_where_its_hash_is_asked_for(tmp_path):
    with publish.EarlyHashes([tmp_path / "nix"]) as hashes, pytest.raises(FileNotFoundError, match="nix"):
        hashes.entries()


def test_work_that_fails_does_not_wait_for_the_hashes_of_its_inputs(tmp_path):
    path = tmp_path / "large"
    path.touch()
    os.truncate(path, 200 << 30)  # minutes of hashing, and no disk
    start = time.perf_counter()
    with pytest.raises(ValueError, match="at once"), publish.EarlyHashes([path, path]):
        raise ValueError("at once")
    assert time.perf_counter() - start < 5


def test_work_is_done_beside_the_target_on_its_file_system(tmp_path):
    with publish.Publication(tmp_path / "scene") as publication:
        assert publication.folder.parent == tmp_path
        assert publication.folder.name.startswith(".scene.")
        assert not (tmp_path / "scene").exists()


def test_an_error_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), publish.Publication(tmp_path / "scene") as publication:  # noqa: PT012
        (publication.folder / "a.txt").write_text("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_an_error_leaves_the_old_result_as_it_was(tmp_path):
    target = published(tmp_path / "scene", "old")
    with pytest.raises(RuntimeError), publish.Publication(target) as publication:  # noqa: PT012
        (publication.folder / "a.txt").write_text("half")
        raise RuntimeError
    assert (target / "a.txt").read_text() == "old"
    assert publish.damaged(target) == []
    assert leftovers(tmp_path) == []


def test_a_new_result_replaces_the_old_one_wholly(tmp_path):
    target = published(tmp_path / "scene", "old")
    (target / "of_old_only.txt").write_text("x")
    published(target, "new")
    assert sorted(path.name for path in target.iterdir()) == ["a.txt", "b.txt", "manifest.json"]
    assert (target / "a.txt").read_text() == "new"
    assert leftovers(tmp_path) == []


def test_a_commit_that_fails_is_an_output_error_and_leaves_the_old_result(tmp_path, monkeypatch):
    target = published(tmp_path / "scene", "old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"scene cannot be published: .*No space left"):
        published(target)
    assert (target / "a.txt").read_text() == "old"
    assert leftovers(tmp_path) == []


def test_everything_is_flushed_before_the_rename_and_the_manifest_is_last(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr(publish, "_flush", lambda path: flushed.append((path.name, (tmp_path / "scene").exists())))
    published(tmp_path / "scene")
    names = [name for name, _ in flushed]
    assert names[:3] == ["a.txt", "b.txt", "manifest.json"]
    assert [done for _, done in flushed] == [False] * (len(flushed) - 1) + [True]


def test_a_folder_that_cannot_be_made_is_an_output_error(tmp_path):
    (tmp_path / "file").write_text("x")
    with (
        pytest.raises(OutputError, match=f"the output folder {tmp_path / 'file'} cannot be written"),
        publish.Publication(tmp_path / "file" / "scene"),
    ):
        pass


KILLED = """
import os, signal, sys
from pathlib import Path
from tscorr import publish

with publish.Publication(Path(sys.argv[1])) as publication:
    (publication.folder / "a.txt").write_text("new")
    steps = 0
    def flush(path, real=publish._flush):
        global steps
        steps += 1
        if steps == int(sys.argv[2]):
            os.kill(os.getpid(), signal.SIGKILL)
        real(path)
    publish._flush = flush
    publication.commit({"key": "k"})
"""


@pytest.mark.parametrize("step", range(1, 5))
def test_a_killed_commit_leaves_the_old_or_the_new_result_whole(tmp_path, step):
    target = published(tmp_path / "scene", "old")
    result = subprocess.run([sys.executable, "-c", KILLED, target, str(step)], check=False)
    assert result.returncode == -signal.SIGKILL
    assert publish.damaged(target) == []
    assert (target / "a.txt").read_text() == ("new" if step == 4 else "old")
    published(target, "next")
    assert (target / "a.txt").read_text() == "next"


def test_equal_content_has_an_equal_key_and_every_change_changes_it(tmp_path):
    file = tmp_path / "input"
    file.write_text("x")
    settings = {"a": 1, "b": [1, 2]}
    whole = publish.identities([file])
    key = publish.key(settings, whole, "1.0")
    assert publish.key({"b": [1, 2], "a": 1}, whole, "1.0") == key
    assert publish.key({**settings, "a": 2}, whole, "1.0") != key
    assert publish.key(settings, whole, "1.1") != key
    assert publish.key(settings, {}, "1.0") != key
    os.utime(file, ns=(1, 1))
    touched = publish.key(settings, publish.identities([file]), "1.0")
    assert touched != key
    file.write_text("xy")
    os.utime(file, ns=(1, 1))
    assert publish.key(settings, publish.identities([file]), "1.0") != touched
    file.unlink()
    with pytest.raises(InputError, match=f"the input {file} cannot be read: No such file"):
        publish.identities([file])


def test_a_result_is_current_only_with_its_key_and_all_its_files(tmp_path):
    target = published(tmp_path / "scene")
    assert publish.is_current(target, "k")
    assert not publish.is_current(target, "other")
    assert not publish.is_current(tmp_path / "nix", "k")
    assert publish.is_current(target, "k", ["corrected"])
    assert not publish.is_current(target, "k", ["corrected", "angles"])
    (target / "a.txt").write_text("longer than it was")
    assert not publish.is_current(target, "k")
    (target / "a.txt").unlink()
    assert not publish.is_current(target, "k")


@pytest.mark.parametrize("text", ["", "[]", "{", '{"key": "k"', "{}"])
def test_a_manifest_that_is_none_makes_no_result_current(tmp_path, text):
    target = published(tmp_path / "scene")
    (target / "manifest.json").write_text(text)
    assert not publish.is_current(target, "k")
    assert publish.damaged(target)


def test_damage_is_found_by_hash(tmp_path):
    target = published(tmp_path / "scene")
    assert publish.damaged(target) == []
    (target / "a.txt").write_text("nex")  # as long as before
    (target / "b.txt").unlink()
    assert publish.damaged(target) == [
        f"{target / 'a.txt'} has changed since it was published",
        f"{target / 'b.txt'} is missing",
    ]


def test_what_killed_runs_left_is_cleared_up_and_nothing_else(tmp_path):
    published(tmp_path / ".a.01234567.old", "old")  # killed between the two renames of a
    published(tmp_path / ".a.89abcdef.part", "new")
    published(tmp_path / "b", "new")
    published(tmp_path / ".b.01234567.old", "old")  # killed before the old b was deleted
    (tmp_path / ".c.01234567.old").mkdir()  # killed while it was being deleted
    (tmp_path / ".index.html.01234567.part").write_text("<")
    for name in (".git", ".d.0123.part", ".e.01234567.keep", ".tscorr.lock"):
        (tmp_path / name).mkdir()
    (tmp_path / ".f.01234567.part").symlink_to(tmp_path / ".git")
    done = publish.recover(tmp_path)
    assert len(done) == 6
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".d.0123.part",
        ".e.01234567.keep",
        ".git",
        ".tscorr.lock",
        "a",
        "b",
    ]
    assert (tmp_path / "a" / "a.txt").read_text() == "old"
    assert (tmp_path / "b" / "a.txt").read_text() == "new"
    assert publish.damaged(tmp_path / "a") == []
    assert publish.recover(tmp_path) == []


def test_a_text_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    publish.write_whole(tmp_path / "page", "old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        publish.write_whole(tmp_path / "page", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["page"]
    assert (tmp_path / "page").read_text() == "old"


def test_every_flipped_byte_and_every_strange_file_is_found(tmp_path):
    target = published(tmp_path / "scene")
    rng = np.random.default_rng(5)
    files = sorted(target.iterdir())
    for path in files:
        content = path.read_bytes()
        for place in rng.integers(0, len(content), 60):
            flipped = bytearray(content)
            flipped[place] ^= 1 << rng.integers(8)
            path.write_bytes(flipped)
            assert publish.damaged(target), (path.name, place)
        path.write_bytes(content)
    assert publish.damaged(target) == []
    (target / "c.txt").write_text("c")
    assert publish.damaged(target) == [f"{target / 'c.txt'} was not published"]


def test_what_killed_runs_left_is_not_taken_for_published(tmp_path):
    published(tmp_path / "a" / "scene")
    published(tmp_path / ".b.01234567.old")
    published(tmp_path / ".c.01234567.part")
    published(tmp_path / ".d.0123456789ab-512.strips" / "0000")
    assert publish.published(tmp_path) == [tmp_path / "a" / "scene"]
