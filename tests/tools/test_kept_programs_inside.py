"""Programs that are kept in a folder: loaded instead of traced, and right whatever is in it."""

import os
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import jax
import numpy as np
import pytest

import jimpact as ji
from jimpact.tools import kept_programs

PAIR = ji.chain([1.0, 3.0])
STRIKE = np.array([1.0, -0.2])
EXPECTED = np.array([0.1, 0.1]) + 0.6 * 1.2 * np.array([-0.75, 0.25])


@pytest.fixture
def folder(tmp_path):
    """A folder in which programs are kept during a test."""
    ji.keep_programs(tmp_path)
    yield tmp_path
    kept_programs._keeper.clear()


def impact() -> np.ndarray:
    """v+ of a pair, as a new process would compute it: nothing in memory."""
    kept_programs._keeper[:] = [
        kept_programs.Keeper(keeper.folder) for keeper in kept_programs._keeper
    ]
    return np.asarray(ji.impact(ji.Newton(0.6), PAIR, STRIKE).velocity)


def programs(folder) -> list[Path]:
    return sorted(folder.glob("*.program"))


def is_loaded(monkeypatch, path) -> bool:
    """True if the next impact comes from a file, not from the compiler."""
    written = []
    monkeypatch.setattr(
        kept_programs, "_write", lambda *arguments: written.append(arguments)
    )
    np.testing.assert_allclose(impact(), EXPECTED, rtol=1e-14)
    monkeypatch.undo()
    return not written


def test_a_program_is_loaded_and_gives_the_same_bits(folder, monkeypatch):
    first = impact()
    np.testing.assert_allclose(first, EXPECTED, rtol=1e-14)
    assert len(programs(folder)) == 1
    assert is_loaded(monkeypatch, folder)
    np.testing.assert_array_equal(impact(), first)
    other = ji.impact(
        ji.Newton(0.3), PAIR, [2.0, 0.5]
    ).velocity  # other numbers, the same program
    np.testing.assert_allclose(
        other, np.array([0.875, 0.875]) + 0.45 * np.array([-0.75, 0.25])
    )
    assert len(programs(folder)) == 1


def bit_flipped(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def half_written(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(path):
    path.write_bytes(b"")


def of_another_program(path):
    """A whole file, under the name of another one."""
    ji.impact(ji.Moreau(0.6), PAIR, STRIKE)
    (other,) = [x for x in path.parent.glob("*.program") if x != path]
    path.write_bytes(other.read_bytes())


def writable_by_others(path):
    path.chmod(0o666)


@pytest.mark.parametrize(
    "damage",
    [bit_flipped, half_written, emptied, of_another_program, writable_by_others],
)
def test_a_file_that_cannot_be_trusted_counts_as_none(folder, monkeypatch, damage):
    impact()
    (path,) = programs(folder)
    damage(path)
    assert not is_loaded(monkeypatch, folder)
    np.testing.assert_allclose(impact(), EXPECTED, rtol=1e-14)  # and it is written anew
    assert is_loaded(monkeypatch, folder)


def test_a_file_of_another_user_counts_as_none(folder, monkeypatch):
    impact()
    user = os.getuid()
    monkeypatch.setattr(kept_programs.os, "getuid", lambda: user + 1)
    written = []
    monkeypatch.setattr(
        kept_programs, "_write", lambda *arguments: written.append(arguments)
    )
    np.testing.assert_allclose(impact(), EXPECTED, rtol=1e-14)
    assert written


def test_other_sources_are_another_program(folder, monkeypatch):
    impact()
    monkeypatch.setattr(kept_programs, "_ground", lambda: "another version")
    np.testing.assert_allclose(impact(), EXPECTED, rtol=1e-14)
    assert len(programs(folder)) == 2


@pytest.mark.parametrize("precision", [True, False])
def test_precision_is_part_of_the_name(folder, precision):
    with jax.enable_x64(precision):
        v = ji.impact(ji.Newton(0.6), ji.chain([1.0, 3.0]), STRIKE).velocity
    assert v.dtype == (np.float64 if precision else np.float32)
    np.testing.assert_allclose(v, EXPECTED, rtol=1e-6)
    np.testing.assert_allclose(impact(), EXPECTED, rtol=1e-14)
    assert len(programs(folder)) == (1 if precision else 2)


@pytest.mark.parametrize("place", ["mkstemp", "fdopen", "replace"])
def test_a_full_disk_and_a_folder_to_be_read_only_leave_results_right(
    folder, monkeypatch, place
):
    def fails(*_, **__):
        raise OSError(28, "No space left on device")

    owner = tempfile if place == "mkstemp" else os
    monkeypatch.setattr(owner, place, fails)
    np.testing.assert_allclose(impact(), EXPECTED, rtol=1e-14)
    assert programs(folder) == []


def test_what_is_a_users_own_is_not_kept(folder):
    class Own(ji.Law):
        restitution: jax.Array = ji.parameter(low=0, high=1)

        def impulses(self, contact):
            return ji.Impulses((1 + self.restitution) * -contact.gap_velocity / 1.0)

    ji.impact(Own(0.6), PAIR, STRIKE)
    soft = ji.UserForce(lambda x, rate, k: k * x, 3.0)
    ji.impact(ji.Compliant(soft), PAIR, STRIKE)
    assert programs(folder) == []


def test_traced_impacts_are_as_before(folder):
    def after(e):
        return ji.impact(ji.Newton(e), PAIR, STRIKE).velocity[0]

    for function in (jax.grad(after), jax.jit(jax.grad(after)), jax.jacfwd(after)):
        np.testing.assert_allclose(function(0.6), -0.9, rtol=1e-12)
    batch = jax.vmap(after)(np.array([0.0, 0.6]))
    np.testing.assert_allclose(batch, [0.1, EXPECTED[0]], rtol=1e-12)
    assert programs(folder) == []


def test_the_folder_is_bounded_says_what_it_holds_and_is_emptied(folder, monkeypatch):
    kept = kept_programs.KeptPrograms(folder)
    impact()
    assert "1 compiled programs" in str(kept)
    (first,) = kept.files
    os.utime(first, (1.0, 1.0))
    monkeypatch.setattr(kept_programs, "LARGEST", first.stat().st_size + 1000)
    ji.impact(ji.Moreau(0.6), PAIR, STRIKE)
    assert first not in kept.files
    assert len(kept.files) == 1
    kept.clear()
    assert kept.files == []


def test_bad_folders_are_refused(tmp_path):
    with pytest.raises(TypeError, match="`folder`"):
        ji.keep_programs(3)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        ji.keep_programs(tmp_path / "file")
    assert kept_programs.keeper() is None


SCRIPT = textwrap.dedent("""
    import sys

    import jax

    jax.config.update("jax_enable_x64", True)
    import jimpact as ji

    ji.keep_programs(sys.argv[1])
    law, balls = ji.LZB(0.9), ji.chain([1.0, 1.0, 1.0])
    data = ji.Experiments([[1.0, 0, 0], [2.0, 0, 0]], [[0, 0.1, 0.9], [0.1, 0.2, 1.8]], sigma=0.1)
    fit = ji.fit(law, balls, data, free="restitution", starts=1)
    print(ji.impact(law, balls, [1.0, 0, 0]).velocity.tolist(), fit.value.tolist(), str(fit))
""")


@pytest.mark.slow
def test_two_processes_at_once_and_a_third_later(tmp_path):
    """Fits, whose programs call LAPACK, too; both write, the third one loads."""
    command = [sys.executable, "-c", SCRIPT, str(tmp_path)]
    pipes = {"stdout": subprocess.PIPE, "text": True}
    both = [subprocess.Popen(command, **pipes) for _ in range(2)]
    said = [process.communicate()[0] for process in both]
    files = {path.name: path.stat().st_mtime_ns for path in programs(tmp_path)}
    said.append(subprocess.run(command, check=True, **pipes).stdout)
    assert said[0]
    assert said[0] == said[1] == said[2]
    assert set(files) == {path.name for path in programs(tmp_path)}
    assert [path for path in tmp_path.iterdir() if path.suffix != ".program"] == []
