from __future__ import annotations

import asyncio
import io
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import chromium
import numpy as np
import pytest
import viser
import viser.transforms
import websockets
from chromium import Chromium, Tab, browser
from PIL import Image
from viser import _messages

from labeler_scenes import page_of
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.pregrasp.labeler import poses as store
from pgdm.pregrasp.labeler.guard import HOST
from pgdm.pregrasp.labeler.page import LabelPage
from pgdm.pregrasp.labeler.panel import PAUSE_S

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("library_home"),
    pytest.mark.skipif(chromium.PROGRAM is None, reason="needs chromium"),
]

TASK = "hammer-use1"
PATIENCE_S = 120.0
SIZE = 760, 480  # of the page, pixels; the panel takes 324 of the width
HEIGHT = 1  # index of the wrist's height in qpos
INPUT = (
    "(() => { const name = [...document.querySelectorAll('*')].filter(e => !e.children.length && "
    "e.innerText === '%s')[0]; let row = name; while (!row.querySelector('input[type=text]')) "
    "row = row.parentElement; return row.querySelector('input[type=text]'); })()"
)
PROGRAM = "import sys; from pgdm.cli.main import main; sys.exit(main(sys.argv[1:]))"


@pytest.fixture(scope="module")
def chrome() -> Iterator[Chromium]:
    with browser() as running:
        yield running


@pytest.fixture
def page() -> Iterator[LabelPage]:
    with page_of(TASK) as served:
        yield served


@pytest.fixture
def tab(chrome: Chromium, page: LabelPage) -> Iterator[Tab]:
    tab = opened(chrome, page)
    yield tab
    tab.close()


def opened(chrome: Chromium, page: LabelPage) -> Tab:
    tab = chrome.tab(SIZE)
    before = len(page.server.get_clients())
    tab.open(page.url, "touches nothing")
    until(lambda: len(page.server.get_clients()) > before)
    until(lambda: colours(tab) > 100)  # an empty page has only a few
    return tab


def colours(tab: Tab) -> int:
    """Return the number of colours in the region of hand and object."""
    with Image.open(io.BytesIO(tab.picture())) as picture:
        seen = np.asarray(picture.convert("RGB"))[100:400, 50:400].reshape(-1, 3)
    return len(np.unique(seen // 8, axis=0))


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition, long enough for a busy machine."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def pixel(client: viser.ClientHandle, point: np.ndarray) -> tuple[float, float]:
    """Return the pixel of a point (3,) m, world frame, on a page."""
    camera = client.camera
    x, y, z = viser.transforms.SO3(camera.wxyz).as_matrix().T @ (point - camera.position)
    scale = camera.image_height / 2 / np.tan(camera.fov / 2) / z
    return float(x * scale + camera.image_width / 2), float(y * scale + camera.image_height / 2)


def drag(tab: Tab, page: LabelPage, handle: viser.TransformControlsHandle, shift_m: float) -> None:
    """Drag the arrow of a handle along its third axis."""
    client = next(iter(page.server.get_clients().values()))
    axis = viser.transforms.SO3(np.array(handle.wxyz)).as_matrix()[:, 2]
    grip = np.array(handle.position) + 0.9 * handle.scale * axis
    tab.drag(pixel(client, grip), pixel(client, grip + shift_m * axis))


def released(page: LabelPage) -> bool:
    """Return whether no handle is being dragged, and the page has followed the last one."""
    return page.dragged is None and page.mailbox.wait(5)


def test_page_shows_the_scene(tab: Tab, page: LabelPage) -> None:
    text = tab.text()
    for words in ("pgdm labeler", TASK, "hand adroit", "starts from the planned pre-grasp"):
        assert words in text
    for group in ("Wrist", "Index", "Middle", "Ring", "Little", "Thumb", "height [mm]"):
        assert group in text


def test_typing_and_undo(tab: Tab, page: LabelPage) -> None:
    state, before = page.state, page.state.qpos[HEIGHT]
    tab.type_into(INPUT % "height [mm]", "-150")
    until(lambda: abs(state.qpos[HEIGHT] + 0.15) < 1e-9)
    time.sleep(PAUSE_S)  # otherwise both are one gesture of the slider
    tab.type_into(INPUT % "height [mm]", "-9999")  # its limit is -200
    until(lambda: abs(state.qpos[HEIGHT] + 0.2) < 1e-9)
    tab.wait("document.body.innerText.includes(' mm inside ')")
    tab.script("document.activeElement.blur()")
    tab.key("z", "KeyZ", 90, modifiers=2)
    until(lambda: abs(state.qpos[HEIGHT] + 0.15) < 1e-9)
    tab.click_button("Undo")
    until(lambda: state.qpos[HEIGHT] == before)
    tab.click_button("Redo")
    until(lambda: abs(state.qpos[HEIGHT] + 0.15) < 1e-9)
    tab.click_button("Start pose")
    until(lambda: state.qpos[HEIGHT] == before)


def test_presets_on_two_open_pages(chrome: Chromium, tab: Tab, page: LabelPage) -> None:
    other = opened(chrome, page)
    tab.click_button("none")
    until(lambda: not page.state.qpos[:30].any())
    for one in (tab, other):
        one.wait("document.body.innerText.includes('loaded the reset pose')")
        one.wait(f"{INPUT % 'height [mm]'}.value === '0'")
    other.type_into(INPUT % "height [mm]", "50")
    until(lambda: abs(page.state.qpos[HEIGHT] - 0.05) < 1e-9)
    tab.wait(f"{INPUT % 'height [mm]'}.value === '50'")
    other.close()


def test_handles_are_dragged(tab: Tab, page: LabelPage) -> None:
    stage, state = page.stage, page.state
    before = state.qpos
    drag(tab, page, stage.wrist, 0.05)
    until(lambda: not np.array_equal(state.qpos[:6], before[:6]) and released(page))
    np.testing.assert_array_equal(state.qpos[6:], before[6:])
    moved = state.kinematics.wrist_pose(state.qpos)[0] - state.kinematics.wrist_pose(before)[0]
    assert 0.01 < np.linalg.norm(moved) < 0.15
    placed = state.qpos
    drag(tab, page, stage.tips[0], 0.02)
    until(lambda: not np.array_equal(state.qpos[8:12], placed[8:12]) and released(page))
    np.testing.assert_array_equal(state.qpos[12:], placed[12:])
    # Once released, the handle jumps back to the fingertip.
    tip = state.kinematics.tip(state.qpos, 0)
    until(lambda: np.allclose(stage.tips[0].position, tip, atol=1e-6))
    tab.click_button("Undo")
    until(lambda: np.array_equal(state.qpos, placed))
    tab.click_button("Undo")
    until(lambda: np.array_equal(state.qpos, before))


def test_saving(tab: Tab, page: LabelPage) -> None:
    path = store.path(page.state.scene)
    tab.type_into(INPUT % "height [mm]", "-200")
    until(lambda: not page.state.metrics.free and page.mailbox.wait(5))
    until(lambda: store.draft_path(page.state.scene).is_file())
    tab.click_button("Save")
    tab.wait("document.body.innerText.includes('not saved: a pre-grasp must touch nothing')")
    assert not path.exists()
    tab.click_button("Save anyway")
    tab.wait("document.body.innerText.includes('task=hammer-use1 hand=adroit pregrasp=labeled')")
    found = pregrasp_file.read(path)
    np.testing.assert_array_equal(found.pose.qpos, page.state.qpos)
    assert "inside" in found.note["saved_anyway"] and found.reached is None
    assert not store.draft_path(page.state.scene).exists()


def test_trial_is_shown_and_saved(tab: Tab, page: LabelPage) -> None:
    tab.type_into(INPUT % "height [mm]", "-200")  # in the table: the search takes long
    until(lambda: not page.state.metrics.free and page.mailbox.wait(5))
    tab.click_button("Try it")
    tab.wait("document.body.innerText.includes('planning the reach: round')", PATIENCE_S)
    tab.type_into(INPUT % "height [mm]", "-150")  # the page still responds
    until(lambda: abs(page.state.qpos[HEIGHT] + 0.15) < 1e-9)
    assert not page.idle
    tab.click_button("Cancel")
    tab.wait("document.body.innerText.includes('cancelled')", PATIENCE_S)
    until(lambda: page.idle)
    tab.click_button("Start pose")
    tab.click_button("Try it")
    tab.wait("document.body.innerText.includes('closing policies lift the object')", PATIENCE_S)
    until(lambda: page.idle)
    assert "the hand reaches the pose" in tab.text()
    tab.click_button("Save")
    tab.wait("document.body.innerText.includes('saved pose and reach')", PATIENCE_S)
    found = pregrasp_file.read(store.path(page.state.scene))
    assert found.reached is not None and found.reached.actions is not None
    assert found.note["reached"] and 0.0 <= found.note["lift_rate"] <= 1.0
    assert np.abs(found.reached.qpos[:30] - found.pose.qpos[:30]).max() < 0.11


def test_pages_of_other_sites_and_tunnels_are_refused(page: LabelPage) -> None:
    address = page.url.replace("http", "ws")
    inner = page.server._websock_server
    assert _messages.ShareUrlRequest not in inner._incoming_handlers

    async def stays(origin: str | None) -> bool:
        protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
        async with websockets.connect(
            address,
            origin=None if origin is None else websockets.Origin(origin),
            subprotocols=[protocol],
            max_size=None,
            proxy=None,
        ) as client:
            try:
                await asyncio.wait_for(client.recv(), 30)
            except websockets.ConnectionClosed as error:
                assert error.rcvd is not None and error.rcvd.code == 1008
                return False
            return True

    assert asyncio.run(stays(page.url))
    assert asyncio.run(stays(None))
    assert not asyncio.run(stays("http://elsewhere.example"))
    assert not asyncio.run(stays(f"http://{HOST}:1"))


def started(port: int, *options: str) -> tuple[subprocess.Popen[str], str, str]:
    """Start the command; return it with its output so far and the page's URL."""
    command = [sys.executable, "-c", PROGRAM, "pregrasp", "label", TASK, "--no-browser"]
    process = subprocess.Popen(
        [*command, "--port", str(port), *options],
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if "Ctrl-C" in line:
            break
    printed = "".join(lines)
    found = re.search(rf"http://{re.escape(HOST)}:\d+", printed)
    assert found, printed
    return process, printed, found.group()


def ended(process: subprocess.Popen[str], number: signal.Signals) -> str:
    process.send_signal(number)
    output, _ = process.communicate(timeout=PATIENCE_S)
    return output


def test_command_keeps_the_draft_however_it_is_stopped(chrome: Chromium) -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        process, printed, url = started(port)
        assert f"port {port} is taken" in printed and not url.endswith(str(port))
        tab = chrome.tab(SIZE)
        tab.open(url, "touches nothing")
        tab.type_into(INPUT % "height [mm]", "-140")
        user = Path(os.environ["PGDM_USER_DIR"]) / "pregrasps" / TASK / "adroit"
        until((user / "labeled.draft.npz").is_file)
        second = subprocess.run(
            [sys.executable, "-c", PROGRAM, "pregrasp", "label", TASK, "--no-browser"],
            capture_output=True,
            text=True,
            check=False,
        )
        *waiting, error = second.stderr.splitlines()
        assert second.returncode == 1 and set(waiting) <= {"loading torch and MuJoCo"}
        assert "is open in another labeler" in error
        ended(process, signal.SIGKILL)
    process, printed, url = started(0)
    assert "draft of " in printed and "port 0" not in printed
    tab.open(url, "unsaved draft of")
    tab.wait(f"{INPUT % 'height [mm]'}.value === '-140'")
    tab.type_into(INPUT % "height [mm]", "-130")
    tab.wait(f"{INPUT % 'height [mm]'}.value === '-130'")
    time.sleep(0.5)  # until the server has it
    output = ended(process, signal.SIGINT)
    assert process.returncode == 0 and "labeler closed; the unsaved draft is kept: " in output
    kept = pregrasp_file.read(user / "labeled.draft.npz")
    assert abs(kept.pose.qpos[HEIGHT] + 0.13) < 1e-9
    process, printed, _ = started(0, "--from", "mined")
    assert "an earlier draft is kept as labeled.draft-before-1.npz" in printed
    ended(process, signal.SIGTERM)
    assert process.returncode == 0


def test_an_earlier_label_is_replaced_only_if_confirmed() -> None:
    with page_of(TASK) as page:
        path = store.path(page.state.scene)
        page.save()
        assert page.mailbox.wait()
        page.mailbox.post(lambda: page.state.set_joint(9, 0.6))
        page.save()  # its own, a moment ago
        assert page.mailbox.wait()
    first = pregrasp_file.read(path).pose.qpos
    with page_of(TASK) as page:
        page.mailbox.post(lambda: page.state.set_joint(9, 0.3))
        page.save()
        assert page.mailbox.wait()
        assert page.panel._anyway.visible
        np.testing.assert_array_equal(pregrasp_file.read(path).pose.qpos, first)
        page.save(anyway=True)
        assert page.mailbox.wait()
        assert pregrasp_file.read(path).pose.qpos[9] == 0.3


def test_a_labeled_pregrasp_trains(tmp_path: Path) -> None:
    with page_of(TASK) as page:
        page.mailbox.post(lambda: page.state.set_joint(9, 0.6))
        page.save()
        assert page.mailbox.wait()
    program = "import sys; from pgdm.cli.run import main; sys.exit(main(sys.argv[1:]))"
    options = [f"task={TASK}", "pregrasp=labeled", "offline=true", "tracking=none"]
    options += ["total_frames=512", "num_envs=4", "algo.steps_per_env=128"]
    done = subprocess.run(
        [sys.executable, "-c", program, *options, f"run_dir={tmp_path / 'run'}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert '"pregrasp_used": "labeled"' in (tmp_path / "run" / "result.json").read_text()
