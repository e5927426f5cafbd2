"""The page in a real browser: drop a file, drag a slider, the image changes, the export downloads."""

import io
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.data.conftest import encode
from tests.report.viewer.serving import serving

from derender import load
from derender.data.synthetic import faces
from derender.features import FeatureTable, embed_images
from derender.model import Derenderer
from derender.report.viewer.app import Application
from derender.report.viewer.images import Example, Gallery
from derender.report.viewer.studio import Shelf, Studio

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = os.environ.get("DERENDER_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here (DERENDER_CHROMIUM names one)")
PATIENCE_MS = 60_000
SIZES = ("DRAFT = 256, SETTLED = 512, TEXTURE = 1024", "DRAFT = 64, SETTLED = 80, TEXTURE = 96")


@pytest.fixture(scope="module")
def rendered() -> np.ndarray:
    return faces.generate(3, 64, seed=5).images


@pytest.fixture(scope="module")
def address(rendered) -> Iterator[str]:
    model = load("rendered-faces-64")
    model = model.with_features(model.features.with_steps(2))
    made = {"fit_steps": 2}
    table = FeatureTable(("a<b>.png", "b.png", "c.png"), embed_images(model, rendered), {}, made)
    examples = [Example(f"<i>face</i> {at}", one.transpose(1, 2, 0)) for at, one in enumerate(rendered)]
    studio = Studio(model, "rendered-faces-64", Shelf(3), examples, Gallery(table))
    with serving(Application(studio)) as url, pytest.MonkeyPatch.context() as patch:
        patch.setattr("derender.report.viewer.studio.FILM_FRAMES", 3)
        patch.setattr("derender.report.viewer.studio.SURFACE_SIZE", 64)
        yield url


@pytest.fixture(scope="module")
def browser():
    arguments = ["--no-sandbox", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield running
        running.close()


def begun(browser, **context: object):
    """An empty page, patient with slow machines."""
    shown = browser.new_context(**context).new_page()
    shown.set_default_timeout(PATIENCE_MS)
    return shown


def smaller(route) -> None:
    """The page's script, with smaller images."""
    script = route.fetch()
    route.fulfill(response=script, body=script.text().replace(*SIZES))


@pytest.fixture(scope="module")
def empty(browser):
    """A page that will have smaller images; what it has asked for, and complained of."""
    shown, asked, wrong = begun(browser, viewport={"width": 1200, "height": 900}), [], []
    shown.route("**/view.js", smaller)
    shown.on("request", lambda request: asked.append(request.url))
    shown.on("pageerror", lambda error: wrong.append(str(error)))
    refusal = "Failed to load resource"  # which the page puts into words
    shown.on("console", lambda m: m.type == "error" and refusal not in m.text and wrong.append(m.text))
    yield shown, asked, wrong
    shown.context.close()


@pytest.fixture
def page(empty, address):
    """The page, opened; at the end it must have asked no other server and shown no error."""
    shown, asked, wrong = empty
    asked.clear()
    shown.goto(address)
    shown.wait_for_selector("body[data-ready]")
    yield shown
    assert not wrong
    assert all(url.startswith((address, "data:", f"blob:{address}")) for url in asked)


def pixels(page, selector: str) -> np.ndarray:
    """What an element shows now."""
    shown = Image.open(io.BytesIO(page.locator(selector).screenshot()))
    return np.asarray(shown.convert("RGB")).astype(float)


def set_slider(page, name: str, value: float) -> None:
    page.locator(f"#{name}").fill(str(value))
    at_rest(page)


def until(page, seen) -> None:
    """Wait, as long as a slow machine needs, until something is seen."""
    for _ in range(PATIENCE_MS // 100):
        if seen():
            return
        page.wait_for_timeout(100)
    pytest.fail("it was never seen")


def at_rest(page) -> None:
    page.wait_for_selector('#view[data-still="true"]')
    page.wait_for_selector("body:not([data-busy])")


def png(picture: np.ndarray) -> bytes:
    return encode(picture.transpose(1, 2, 0))


def dropped(page, name: str, content: bytes) -> None:
    before = page.eval_on_selector("body", "element => element.dataset.ready")
    drop = """(zone, [name, bytes]) => {
      const given = new DataTransfer();
      given.items.add(new File([new Uint8Array(bytes)], name, {type: "image/png"}));
      zone.dispatchEvent(new DragEvent("drop", {dataTransfer: given, bubbles: true, cancelable: true}));
    }"""
    page.eval_on_selector("#drop", drop, [name, list(content)])
    page.wait_for_selector(f'body:not([data-ready="{before}"])')


def saved(page, kind: str) -> tuple[str, bytes]:
    with page.expect_download() as download:
        page.click(f"[data-save={kind}]")
    return download.value.suggested_filename, Path(download.value.path()).read_bytes()


def test_drop_a_file_drag_a_slider_save(page, rendered):
    dropped(page, "<b>mine</b>.png", png(rendered[1]))
    assert page.inner_text("#status") == "<b>mine</b>.png: opened."
    assert page.inner_text("#error").startswith("Mean difference")

    set_slider(page, "light-diffuse", 1.0)
    set_slider(page, "light-yaw", 60)
    page.check("[name=drag][value=camera]", force=True)  # no sun before it
    left = pixels(page, "#view")
    set_slider(page, "light-yaw", -60)
    right = pixels(page, "#view")
    half = left.shape[1] // 2  # yaw > 0 lights the left of the image
    change = left - right
    assert change[:, : half // 2].mean() > 3 > -3 > change[:, -half // 2 :].mean()
    assert np.abs(pixels(page, "#map-shading")).mean() > 1

    name, content = saved(page, "archive")
    assert name == "_b_mine_b_-archive.zip"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert {"panel.png", "view.png", "surface.glb"} <= set(archive.namelist())
        assert json.loads(archive.read("settings.json"))["light"]["yaw_deg"] == -60
    with Image.open(io.BytesIO(saved(page, "picture")[1])) as picture:
        assert picture.size == (64, 64)  # the photograph's own
    assert saved(page, "gif")[1].startswith(b"GIF8")


def test_the_result_is_dragged_compared_and_reset_and_the_surface_turned(page):
    at_rest(page)
    original = pixels(page, "#view-sheet")
    box = page.locator("#view").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for mode, value in (("light", "#light-yaw"), ("camera", "#camera-yaw")):
        page.check(f"[name=drag][value={mode}]", force=True)
        was = float(page.input_value(value))
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - box["width"] / 10, y, steps=3)
        page.mouse.up()
        at_rest(page)
        assert float(page.input_value(value)) > was  # the light comes from where it was dragged to
    assert np.abs(pixels(page, "#view-sheet") - original).mean() > 2
    page.locator("#compare").fill("100")
    assert np.abs(pixels(page, "#view-sheet") - original).mean() < 2  # the sun is hidden, too
    page.click("#reset")
    page.locator("#compare").fill("0")
    assert page.locator("#sun").is_hidden()
    at_rest(page)

    assert page.eval_on_selector("#surface", "element => element.dataset.drawn") == "webgl"
    page.locator("#surface").scroll_into_view_if_needed()
    page.wait_for_timeout(300)
    front = pixels(page, "#surface")
    assert front.std() > 10  # something is drawn
    page.focus("#surface")
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    until(page, lambda: np.abs(pixels(page, "#surface") - front).mean() > 3)
    page.keyboard.press("0")
    until(page, lambda: np.abs(pixels(page, "#surface") - front).mean() < 1)

    page.click("#examples-second button:nth-child(3)")
    page.wait_for_selector("#swaps:visible")
    albedo = page.get_attribute("#map-albedo", "src")
    page.focus("#swaps [name=albedo]")
    page.keyboard.press("Space")
    page.wait_for_function("before => document.getElementById('map-albedo').src !== before", arg=albedo)
    page.wait_for_selector("#near-rows button")

    names = page.locator("#near-rows button span:last-child").all_inner_texts()
    assert sorted(names) == ["b.png", "c.png"]  # not a<b>.png itself
    page.click('#near-factors [data-factor="albedo"]')
    page.wait_for_selector('#near-rows button:has-text("a<b>.png")')  # near to the second image, c.png
    assert page.locator('#near-rows button:has-text("c.png")').count() == 0
    assert page.locator("#near-rows b, #examples i").count() == 0  # names are text


def test_a_crop_is_moved_a_new_picture_resets_swaps_and_what_is_wrong_is_said(page, rendered):
    page.click("#examples-second button:nth-child(2)")
    page.check("#swaps [name=geometry]")
    large = np.pad(rendered[0].repeat(3, 1).repeat(3, 2), ((0, 0), (40, 60), (80, 120)), mode="edge")
    dropped(page, "large.png", png(large))
    assert not page.is_checked("#swaps [name=geometry]")
    page.locator("#photo-sheet").scroll_into_view_if_needed()
    left = page.eval_on_selector("#crop", "element => element.offsetLeft")
    ready = page.get_attribute("body", "data-ready")
    box = page.locator("#crop").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 20, box["y"] + box["height"] / 2, steps=3)
    page.mouse.up()
    page.wait_for_selector(f'body:not([data-ready="{ready}"])')
    assert page.eval_on_selector("#crop", "element => element.offsetLeft") == left + 20
    assert page.input_value("#framing") == "own"
    ready, width = page.get_attribute("body", "data-ready"), box["width"]
    page.focus("#crop")
    page.keyboard.press("+")
    page.wait_for_selector(f'body:not([data-ready="{ready}"])')
    assert page.locator("#crop").bounding_box()["width"] > width
    ready = page.get_attribute("body", "data-ready")
    page.select_option("#framing", "none")
    page.wait_for_selector(f'body:not([data-ready="{ready}"])')
    assert page.input_value("#framing") == "none"

    wrong = {"name": "a.jpg", "mimeType": "image/jpeg", "buffer": b"<svg onload=alert(1)>"}
    page.set_input_files("#file", wrong)
    page.wait_for_selector("#status.wrong")
    assert "not an image" in page.inner_text("#status")
    for number in (1, 2, 0):  # the shelf holds three: the first goes
        file = {"name": f"{number}.png", "mimeType": "image/png", "buffer": png(rendered[number])}
        page.set_input_files("#file-second", file)
        page.wait_for_selector(f'#second[alt="second photograph: {number}.png"]')
    with page.expect_request("**/api/crop") as cropped:
        set_slider(page, "camera-yaw", 30)  # opens it again, in the crop that was chosen
    assert cropped.value.post_data_json["crop"]["side"] == 292  # the middle of 392 x 292 pixels
    assert "no longer stored" not in page.inner_text("#status")


def test_effects_of_a_renderer_have_sliders(empty, rendered):
    plain = load("rendered-faces-64")
    settings = plain.settings.model_copy(update={"renderer": "phong+lambert-shadow+haze"})
    model = Derenderer.seeded(settings, 0)
    model.load_state_dict(model.state_dict() | plain.state_dict())
    examples = [Example("face", rendered[0].transpose(1, 2, 0))]
    with serving(Application(Studio(model.eval(), "glossy", Shelf(3), examples))) as url:
        shown = empty[0]
        shown.goto(url)
        shown.wait_for_selector("body[data-ready]")
        at_rest(shown)
        assert shown.locator("#numbers-sliders input").count() == 4
        for name in ("highlight", "cast shadow", "transmission"):
            assert shown.locator(f'[id="map-{name}"]').get_attribute("src")
        before = pixels(shown, "#view-sheet")
        for name in ("numbers-haze-airlight", "numbers-haze-beta"):
            shown.focus(f"#{name}")
            shown.keyboard.press("End")
            at_rest(shown)
        assert (pixels(shown, "#view-sheet") - before).mean() > 5  # paler
        assert json.loads(saved(shown, "settings")[1])["numbers"]["haze"] == pytest.approx([4, 1])
        shown.click("#reset")
        at_rest(shown)
        assert np.abs(pixels(shown, "#view-sheet") - before).mean() < 1


def test_it_fits_every_width_and_follows_the_dark(browser, address):
    shown = begun(browser, viewport={"width": 390, "height": 844}, color_scheme="dark", has_touch=True)
    shown.goto(address)
    shown.wait_for_selector("body[data-ready]")
    assert shown.get_attribute("#view", "height") == "512"
    for width, height in ((390, 844), (820, 1180), (1280, 900)):
        shown.set_viewport_size({"width": width, "height": height})
        wide = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
        assert shown.evaluate(wide) == 0
        for name in ("#photo-sheet", "#view-sheet"):  # input and result are seen without scrolling
            box = shown.locator(name).bounding_box()
            assert box["y"] > 0 and box["y"] + box["height"] <= height and box["width"] > 100
    assert shown.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 22, 26)"
    shown.context.close()


def test_without_webgl_the_server_draws_the_orbit(browser, address):
    shown = begun(browser, viewport={"width": 900, "height": 900})
    shown.add_init_script(
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...more) "
        "{ return kind === 'webgl2' ? null : get.call(this, kind, ...more); };"
    )
    shown.goto(address)
    shown.wait_for_selector('#surface[data-drawn="server"][width="256"]')
    at_rest(shown)
    front = pixels(shown, "#surface")
    assert front.std() > 10
    shown.focus("#surface")
    for _ in range(5):
        shown.keyboard.press("ArrowRight")
    until(shown, lambda: np.abs(pixels(shown, "#surface") - front).mean() > 3)
    shown.context.close()
