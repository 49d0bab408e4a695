"""Synthetic scenes: folders, bad input, and nothing left behind."""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

from edge_se_sampler.data.synthetic import folder
from edge_se_sampler.data.synthetic.cameras import FIELD_OF_VIEW, Camera, Placement, Split, framing, poses
from edge_se_sampler.data.synthetic.catalogue import ANALOG_OF, synthetic_scene
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.data.synthetic.render import render
from edge_se_sampler.errors import InputError

SPLITS: tuple[Split, ...] = ("train", "val", "test")
OFFSET = (0.2, -0.15)


def everything_below(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in files}


@pytest.mark.parametrize("placement", ["centered", "padded", "shifted", "rotated"])
def test_pictures_are_what_the_json_says(placement: Placement, tmp_path: Path) -> None:
    """Every picture is what its json says, read as any loader of Blender scenes reads it."""
    size = 24
    folders = make_scenes(
        tmp_path, ["bricks"], size=size, num_train=2, num_val=0, num_test=1, placement=placement, offset=OFFSET, seed=3
    )
    assert folders == [tmp_path / "bricks"]
    assert sorted(everything_below(tmp_path)) == [
        "bricks",
        "bricks/test",
        "bricks/test/r_0.png",
        "bricks/train",
        "bricks/train/r_0.png",
        "bricks/train/r_1.png",
        "bricks/transforms_test.json",
        "bricks/transforms_train.json",
    ]  # and no split without views, which no loader would take
    for split, count in (("train", 2), ("test", 1)):
        document = json.loads((tmp_path / "bricks" / f"transforms_{split}.json").read_text())
        assert document["analog_of"] == "lego"
        assert document["generated_by"] == "edge_se_sampler"
        assert ("cx" in document, "cy" in document) == (placement == "shifted",) * 2
        assert (document["camera_angle_x"] == FIELD_OF_VIEW) == (placement == "centered")
        assert [frame["file_path"] for frame in document["frames"]] == [f"./{split}/r_{i}" for i in range(count)]
        for frame in document["frames"]:
            picture = imageio.imread(tmp_path / "bricks" / f"{frame['file_path']}.png")
            pose = np.array(frame["transform_matrix"])
            assert isinstance(frame["rotation"], float)
            assert pose.shape == (4, 4)
            assert (picture.shape, picture.dtype) == ((size, size, 4), np.uint8)
            focal = 0.5 * size / math.tan(0.5 * document["camera_angle_x"])
            principal = (document.get("cx", size / 2), document.get("cy", size / 2))
            camera = Camera(pose, focal, principal, size, size)
            np.testing.assert_array_equal(picture, render(synthetic_scene("bricks"), camera))
            assert picture[..., 3].max() == 255
            assert not picture[picture[..., 3] == 0].any()


def test_worker_processes_render_the_same_pictures(tmp_path: Path) -> None:
    """Six views and more go to other processes."""
    calls: list[tuple[int, int]] = []
    make_scenes(
        tmp_path / "new" / "out",
        ["mic", "chair"],
        size=16,
        num_train=3,
        num_val=1,
        num_test=2,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert sorted(path.name for path in (tmp_path / "new" / "out").iterdir()) == ["chair", "mic"]
    assert calls == [(done, 12) for done in range(1, 13)]
    for name in ("mic", "chair"):
        assert (
            json.loads((tmp_path / f"new/out/{name}/transforms_val.json").read_text())["analog_of"] == ANALOG_OF[name]
        )
        for split, count in zip(SPLITS, (3, 1, 2), strict=True):
            for index, pose in enumerate(poses(split, count)):
                picture = imageio.imread(tmp_path / f"new/out/{name}/{split}/r_{index}.png")
                np.testing.assert_array_equal(picture, render(synthetic_scene(name), framing(16).camera(pose)))


BAD_ARGUMENTS = [
    pytest.param({"names": ["lego"]}, "'lego'.*mean 'bricks'", id="NeRF's name"),
    pytest.param({"names": ["mic", "chiar"]}, "'chiar'.*mean 'chair'", id="typo"),
    pytest.param({"names": []}, "names is empty", id="no name"),
    pytest.param({"names": ["mic", "mic"]}, "names.*twice", id="twice"),
    pytest.param({"size": 7}, "size is 7.*at least 8", id="size"),
    pytest.param({"size": 10**18}, "size is 10*.*at most 8192", id="large"),
    pytest.param({"num_train": 0}, "num_train is 0.*at least 1", id="no train"),
    pytest.param({"num_val": -1}, "num_val is -1.*at least 0", id="negative val"),
    pytest.param({"num_test": -2}, "num_test is -2.*at least 0", id="negative test"),
    pytest.param({"seed": -1}, "seed is -1", id="negative seed"),
    pytest.param({"seed": 2**31}, "seed is 2147483648", id="large seed"),
    pytest.param({"placement": "centred"}, "placement is 'centred'.*centered", id="placement"),
    pytest.param({"placement": "shifted", "offset": (0.4, 0)}, "offset.*4 pixels.*8", id="offset"),
    pytest.param({"placement": "rotated", "offset": (0, -0.6)}, "offset.*0 pixels.*8", id="offset off the image"),
    pytest.param({"placement": "shifted", "offset": (math.nan, 0)}, "offset.*-1 to 1", id="offset nan"),
    pytest.param({"placement": "shifted", "offset": (1e308, 0)}, "offset.*-1 to 1", id="huge offset"),
    pytest.param({"num_test": 10**20}, "num_test is 1.*at most", id="huge test"),
    pytest.param(
        {"names": ["hotdog"], "placement": "rotated", "offset": (0.3, 0.3)},
        "offset rotates hotdog to the edge.*train/r_0",
        id="clipped",
    ),
]


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS)
def test_refusals_leave_nothing_behind(arguments: dict, message: str, tmp_path: Path) -> None:
    good = {"names": ["mic"], "size": 20, "num_train": 1, "num_val": 0, "num_test": 0}
    with pytest.raises(InputError, match=message) as refusal:
        make_scenes(tmp_path / "deep" / "out", **{**good, **arguments})
    assert "\n" not in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_scene_is_never_touched(tmp_path: Path) -> None:
    (tmp_path / "mic").mkdir()
    (tmp_path / "mic" / "notes.txt").write_text("keep")
    before = everything_below(tmp_path)
    with pytest.raises(InputError, match="mic is there already"):
        make_scenes(tmp_path, ["chair", "mic"], size=8, num_train=1, num_val=0, num_test=0)
    assert everything_below(tmp_path) == before
    make_scenes(tmp_path, ["chair"], size=8, num_train=1, num_val=0, num_test=0)
    assert before.items() < everything_below(tmp_path).items()


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / "mic").mkdir()
    make_scenes(tmp_path, ["mic"], size=8, num_train=1, num_val=0, num_test=0)
    assert (tmp_path / "mic" / "train" / "r_0.png").is_file()


def test_a_folder_filled_meanwhile_is_never_touched(tmp_path: Path) -> None:
    (tmp_path / "mic").mkdir()

    def intrude(done: int, total: int) -> None:
        (tmp_path / "mic" / "notes.txt").write_text("keep")

    with pytest.raises(InputError, match="not empty"):
        make_scenes(tmp_path, ["mic"], size=8, num_train=1, num_val=0, num_test=0, progress=intrude)
    assert everything_below(tmp_path) == {"mic": b"", "mic/notes.txt": b"keep"}


def test_what_fills_one_of_two_folders_meanwhile_leaves_no_other(tmp_path: Path) -> None:
    def intrude(done: int, total: int) -> None:
        (tmp_path / "mic").mkdir(exist_ok=True)
        (tmp_path / "mic" / "notes.txt").write_text("keep")

    with pytest.raises(InputError, match="nothing was left there"):
        make_scenes(tmp_path, ["chair", "mic"], size=8, num_train=1, num_val=0, num_test=0, progress=intrude)
    assert everything_below(tmp_path) == {"mic": b"", "mic/notes.txt": b"keep"}


@pytest.mark.parametrize("out", ["file", "file/below"])
def test_out_that_is_a_file(out: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("keep")
    with pytest.raises(InputError, match=r"out is .*file.* not a folder"):
        make_scenes(tmp_path / out, ["mic"], size=8, num_train=1, num_val=0, num_test=0)
    assert everything_below(tmp_path) == {"file": b"keep"}


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="everything is writable to root")
def test_out_that_is_not_writable(tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    with pytest.raises(InputError, match="not writable"):
        make_scenes(tmp_path / "locked" / "out", ["mic"], size=8, num_train=1, num_val=0, num_test=0)


@pytest.mark.parametrize(
    ("num_train", "error"),
    [pytest.param(2, RuntimeError, id="here"), pytest.param(12, KeyboardInterrupt, id="in processes")],
)
def test_a_failure_leaves_nothing_behind(num_train: int, error: type[BaseException], tmp_path: Path) -> None:
    def fail(done: int, total: int) -> None:
        assert list((tmp_path / "deep" / "out").glob(".partial-*/mic/train/*.png"))  # work was under way
        raise error

    with pytest.raises(error):
        make_scenes(
            tmp_path / "deep" / "out", ["mic"], size=8, num_train=num_train, num_val=0, num_test=0, progress=fail
        )
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_reported_and_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail(done: int, total: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(InputError, match="disk is full"):
        make_scenes(tmp_path / "out", ["mic"], size=8, num_train=1, num_val=0, num_test=0, progress=fail)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no process groups to interrupt")
@pytest.mark.parametrize("moment", ["half a semaphore", "half a worker", "workers starting", "workers at work"])
def test_ctrl_c_stops_quietly(moment: str, tmp_path: Path) -> None:
    """A terminal's Ctrl-C reaches every process of the group; only the first may answer."""
    script = tmp_path / "script.py"
    cut = {
        # it has its name, which nobody would remove yet
        "half a semaphore": "register = resource_tracker.register\n"
        "resource_tracker.register = lambda *given: (register(*given), signal.raise_signal(signal.SIGINT))\n",
        # its process is there, and waits to be told what it is; another thread is as good as any for the signal
        "half a worker": "spawn = util.spawnv_passfds\n"
        "press = lambda: signal.pthread_kill(other.ident, signal.SIGINT)\n"
        "util.spawnv_passfds = lambda *given: (spawn(*given), press())[0]\n",
    }
    script.write_text(
        "import signal, threading\n"
        "from multiprocessing import resource_tracker, util\n"
        "from multiprocessing.context import SpawnProcess\n"
        "from pathlib import Path\n"
        "from edge_se_sampler.data.synthetic.folder import make_scenes\n"
        "start = SpawnProcess.start\n"
        "other = threading.Thread(target=threading.Event().wait, daemon=True)\n"
        "SpawnProcess.start = lambda process: (start(process), print('started', flush=True))\n"
        f"{cut.get(moment, '')}"
        "if __name__ == '__main__':\n"
        "    other.start()\n"
        "    try:\n"
        f"        make_scenes(Path({str(tmp_path / 'out')!r}), ['mic', 'ficus'], num_train=500,\n"
        "                    progress=lambda done, total: print(done, flush=True))\n"
        "    except KeyboardInterrupt:\n"
        "        print('stopped')\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    with subprocess.Popen(
        [sys.executable, str(script)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a shell's background jobs ignore the signal, and hand that on
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        assert process.stdout is not None
        if moment not in cut:
            awaited = {"workers starting": "started\n", "workers at work": "1\n"}[moment]
            assert awaited in iter(process.stdout.readline, "")
            os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert out.splitlines()[-1] == "stopped"
    assert err == ""
    assert process.returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["script.py"]


@pytest.mark.parametrize("problem", [MemoryError(), BrokenProcessPool()])
def test_a_rendering_that_is_killed_is_said_in_a_line(
    problem: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: object) -> bytes:
        raise problem

    monkeypatch.setattr(folder, "_render_png", fail)
    view: Any = None
    with pytest.raises(InputError, match="smaller --size"):
        folder._render_all([view], tmp_path, lambda *_: None)
