"""The report: what it warns of, and the page itself in a browser."""

import base64
import io
import json
import re
import shutil
import struct
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import AXES, CENTER
from matplotlib.figure import Figure
from PIL import Image
from playwright.sync_api import sync_playwright

from mi_ring import fit, images
from mi_ring.capture.loading import load_capture
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.fitting.fit import Fit
from mi_ring.output import report, svg

VIEWER = Path(report.__file__).parent / "viewer"
QUICK = ["--levels", "2", "--widths", "56", "--shares", "1", "--batch", "4", "--subdivisions", "3", "--no-indirect",
         "--domain", "sphere"]  # fmt: skip
DRAWING = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # without a GPU
COLOUR = np.array([230, 170, 120])  # of the box, sRGB


def glb(positions, normals, uv, faces, image, scale=1.0, seen=None):
    """A GLB of a matte mesh whose colour is an image, (H, W, 3) uint8; made by hand: glTF 2.0, section 4.

    `scale`: by which its exporter multiplied the true colour. `seen` (V,): what photographs show; all, by default.
    """
    Image.fromarray(image).save(png := io.BytesIO(), "PNG")
    seen = np.ones(len(positions)) if seen is None else seen
    arrays = [np.asarray(values, "<f4") for values in (positions, normals, uv, seen)]
    arrays += [np.asarray(faces, "<u4").ravel()]
    parts = [array.tobytes() for array in arrays] + [png.getvalue() + b"\0" * (-len(png.getvalue()) % 4)]
    offsets = np.cumsum([0, *map(len, parts)]).tolist()
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2, "_SEEN": 3}
    kinds = [(5126, "VEC3"), (5126, "VEC3"), (5126, "VEC2"), (5126, "SCALAR"), (5125, "SCALAR")]
    content = json.dumps({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 4, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0},
                       "extensions": {"KHR_materials_specular": {"specularFactor": 0.0}},
                       "extras": {"mi_ring": {"scale": scale}}}],
        "extensionsUsed": ["KHR_materials_specular"],
        "textures": [{"source": 0}], "images": [{"bufferView": 5, "mimeType": "image/png"}],
        "buffers": [{"byteLength": offsets[-1]}],
        "bufferViews": [{"buffer": 0, "byteOffset": o, "byteLength": len(part)} for o, part in zip(offsets, parts)],
        "accessors": [
            {"bufferView": i, "componentType": number, "count": len(array), "type": kind,
             "min": np.atleast_1d(array.min(0)).tolist(), "max": np.atleast_1d(array.max(0)).tolist()}
            for i, (array, (number, kind)) in enumerate(zip(arrays, kinds))
        ],
    }).encode()  # fmt: skip
    content += b" " * (-len(content) % 4)
    binary = b"".join(parts)
    chunks = struct.pack("<I4s", len(content), b"JSON") + content + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.fixture(scope="module")
def fitted(small_capture):
    """The result of a quick fit."""
    fitted = Fit(load_capture(small_capture), fit.parse_options([str(small_capture), "--iterations", "30", *QUICK]))
    assert len(list(fitted)) == 30
    return fitted.result()


@pytest.fixture(scope="module")
def page_file(fitted, tmp_path_factory):
    """The report of the quick fit; in its viewer a box."""
    box = trimesh.creation.box(1.5 * AXES, trimesh.transformations.translation_matrix(CENTER))
    corners, normals = box.triangles.reshape(-1, 3), np.repeat(box.face_normals, 3, axis=0)
    file = tmp_path_factory.mktemp("report") / "report.html"
    faces = np.arange(len(corners)).reshape(-1, 3)
    seen = normals[:, 1] == 0
    box = glb(corners, normals, 0 * corners[:, :2], faces, np.tile(COLOUR.astype(np.uint8), (5, 7, 1)), seen=seen)
    file.write_text(report.report_html(fitted, box), "utf-8")
    return file


@pytest.fixture(scope="module")
def browser():
    executable = shutil.which("chromium") or shutil.which("google-chrome")
    if not executable:
        pytest.skip("needs Chromium, which `make tools` installs")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=DRAWING)
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser):
    """A function that opens a file without a network. At the end nothing must have gone wrong or been asked for."""
    contexts, wrong = [], []

    def open_page(file, width=1280, script=None):
        contexts.append(browser.new_context(viewport={"width": width, "height": 800}, offline=True))
        page = contexts[-1].new_page()
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: wrong.append(request.url) if request.url.startswith("http") else None)
        if script:
            page.add_init_script(script)
        page.goto(file.as_uri())
        page.wait_for_function("window.opened === undefined || window.viewer !== undefined")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not wrong


def picture(shot: bytes) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(shot)).convert("RGB")) / 255.0


def test_it_is_one_self_contained_file(page_file, fitted):
    page = page_file.read_text("utf-8")
    body = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    sources = re.findall(r'(?:src|href)="([^"]{0,40})', body)
    assert len(sources) == 2 + 12 * 8 and all(s.startswith("data:") for s in sources)
    assert page.count("<script") == page.count("</script>") == 4 and "<link" not in page
    assert all(f"{k:03}.png" in body for k in range(12))
    without = report.report_html(fitted)
    assert without.count("<script") == 1 and "<canvas" not in without


def test_figures_are_the_same_whenever_they_are_drawn():
    """That of a deterministic fit that was interrupted is that of another one."""
    pages = []
    for _ in range(2):
        drawn = Figure()
        drawn.subplots().plot([1, 3, 2], label="a")
        pages.append(svg.svg_uri(drawn))
    assert pages[0] == pages[1]


HOSTILE = [
    "<script>window.evil = 1</script>", '"><img src="x" onerror="window.evil = 1">', "a\n' onload='window.evil = 1",
    "</script><script>window.evil = 1</script>", "</pre></title></h1><svg onload=window.evil=1>",
    "{{ 7 * 7 }}{% raw %}", "javascript:window.evil=1", "&lt;script&gt;window.evil=1&lt;/script&gt;", "$\\frac{$",
    "%s\u2028\u202e", "<!--", "]]>",
]  # fmt: skip


class Parts(HTMLParser):
    """Names of the elements of a page, and of their attributes; and its text."""

    def __init__(self, page):
        super().__init__()
        self.names, self.text = set(), ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.names |= {tag, *(name for name, _ in attrs)}

    def handle_data(self, data):
        self.text += data


def test_names_that_are_meant_to_run_are_text(page_file, fitted, monkeypatch, open_page, tmp_path):
    """Of photographs, of the scene, of files in the settings: they add no element and no attribute to the page."""
    usual = Parts(page_file.read_text("utf-8"))
    monkeypatch.setattr(type(fitted.capture), "names", property(lambda self: HOSTILE))
    monkeypatch.setattr(report, "scene_name", lambda path: " ".join(HOSTILE))
    page = report.report_html(replace(fitted, settings={"domain": ["mesh", *HOSTILE]}))
    own = Parts(page)
    assert own.names <= usual.names and page.count("<script") == 1
    assert all(own.text.count(name) >= 2 for name in HOSTILE)  # in the heading, and above its pictures
    (tmp_path / "report.html").write_text(page, "utf-8")
    shown = open_page(tmp_path / "report.html")
    assert shown.evaluate("window.evil") is None
    assert shown.locator("section.photograph").count() == 12 and HOSTILE[3] in shown.locator("h1").inner_text()


def test_pictures_are_the_photographs_and_what_was_predicted(page_file, small_capture):
    for title, close in (("photograph", 40), ("prediction", 20)):
        source = re.search(rf'src="data:image/webp;base64,([^"]*)" alt="{title} 007.png"', page_file.read_text("utf-8"))
        shown = picture(base64.b64decode(source[1]))
        truth = picture((small_capture.parent / "images" / "007.png").read_bytes())
        assert shown.shape == truth.shape and -10 * np.log10(np.mean((shown - truth) ** 2)) > close - 8


@pytest.mark.parametrize("width", [1280, 400])
def test_the_viewer_draws_and_everything_moves_it(width, open_page, page_file):
    page = open_page(page_file, width)
    canvas = page.locator("canvas")
    shots = [canvas.screenshot()]

    def changed():
        shots.append(canvas.screenshot())
        return np.abs(picture(shots[-1]) - picture(shots[-2])).max() > 0.1

    assert 0.05 < (picture(shots[0]) > 0.02).any(-1).mean() < 0.9
    box = canvas.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 80, middle[1] + 30, steps=4)
    page.mouse.up()
    assert changed()
    for name, value in (("azimuth", "60"), ("elevation", "-50"), ("brightness", "1.5")):
        page.locator(f"[name={name}]").fill(value)
        assert changed(), name
    for shown in ("diffuse", "specular", "roughness", "normals", "unseen", "shaded"):
        page.locator("[name=show]").select_option(shown)
        assert changed(), shown
    page.locator("[name=reset]").click()
    assert changed() and np.abs(picture(shots[-1]) - picture(shots[0])).max() < 0.02


def test_a_diffuse_box_shows_its_colour_and_its_normals(open_page, page_file):
    page = open_page(page_file)
    page.locator("[name=show]").select_option("diffuse")
    shot = picture(page.locator("canvas").screenshot())  # at its border a line of the page may show
    assert shot[2:-2].max((0, 1)) == pytest.approx(COLOUR / 255, abs=1.01 / 255)
    page.locator("[name=show]").select_option("normals")
    colours = np.unique((picture(page.locator("canvas").screenshot())[2:-2] * 255).round().reshape(-1, 3), axis=0)
    for axis in range(3):  # the axes of the world, for the box has them: one side of each is seen
        sides = [np.where(np.arange(3) == axis, end, 127.5) for end in (0, 255)]
        assert any(np.abs(colours - side).max(1).min() < 1.1 for side in sides)


def test_what_no_photograph_shows_is_magenta_and_the_rest_as_it_was(open_page, page_file):
    """Two sides of the box, of which one is in sight."""
    page, shots = open_page(page_file), {}
    for shown in ("shaded", "normals", "unseen"):
        page.locator("[name=show]").select_option(shown)
        shots[shown] = (picture(page.locator("canvas").screenshot())[2:-2] * 255).round()
    away = {side: np.abs(shots["normals"] - [127.5, side, 127.5]).max(-1) < 1.1 for side in (0, 255)}
    unseen = away[0] | away[255]
    magenta = (shots["unseen"] == [255, 0, 255]).all(-1)
    assert 0.01 < unseen.mean() < 0.5
    assert (magenta == unseen).mean() > 0.998  # but for the edges, which are smoothed
    same = (shots["unseen"] == shots["shaded"]).all(-1)
    assert (same == ~unseen).mean() > 0.995 and (same & (shots["shaded"] > 0).any(-1)).mean() > 0.01


def test_each_slider_moves_its_own_divider(open_page, page_file):
    page = open_page(page_file)
    sliders = page.locator(".compare input")
    assert sliders.count() == 12
    for k in range(12):
        sliders.nth(k).scroll_into_view_if_needed()
        box = sliders.nth(k).bounding_box()
        page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 5)
        insets = page.evaluate("[...document.querySelectorAll('.over')].map((e) => getComputedStyle(e).clipPath)")
        left = [float(re.search(r"([\d.]+)%", inset)[1]) for inset in insets]
        assert left == pytest.approx([25] * (k + 1) + [50] * (11 - k), abs=1)


def test_left_of_the_divider_is_the_photograph(open_page, page_file):
    page = open_page(page_file)
    colours = {}
    for title, colour in (("photograph", (255, 0, 0)), ("prediction", (0, 0, 255))):
        Image.new("RGB", (7, 5), colour).save(file := io.BytesIO(), "PNG")
        colours[title] = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
    page.evaluate("""async (colours) => {
      for (const image of document.querySelectorAll(".compare:first-child img"))
        await Promise.all([image.src = colours[image.alt.split(" ")[0]], image.decode()]);
    }""", colours)  # fmt: skip
    page.locator(".compare input").first.fill("70")
    shot = picture(page.locator(".compare div").first.screenshot())
    row = shot[shot.shape[0] // 2]
    assert (row[int(0.67 * len(row))] == (1, 0, 0)).all() and (row[int(0.73 * len(row))] == (0, 0, 1)).all()


def test_without_webgl_the_rest_of_the_page_works(open_page, page_file):
    page = open_page(page_file, script="HTMLCanvasElement.prototype.getContext = () => null")
    assert "no WebGL" in page.locator("#object").inner_text() and not page.locator("canvas").count()
    page.locator(".compare input").first.fill("10")
    assert "10%" in page.locator(".compare").first.get_attribute("style")


def test_draw_is_the_photograph_that_mitsuba_takes(open_page, page_file, fitted, tmp_path):
    """A parallelogram with a matte image, by hand: ρ / π · cos · I / d² at the middle of each pixel."""
    corner, u, v = np.array([40.0, -15.0, 9.0]), np.array([5.0, 1.0, 0.5]), np.array([-1.0, 4.0, 1.5])
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    intensity = np.array([240.0, 290.0, 400.0])
    image = np.zeros((8, 16, 3), np.uint8)  # in each quarter another colour; its top is at v = 0
    quarters = np.array([[[218, 168, 108], [120, 190, 150]], [[200, 90, 170], [160, 160, 60]]])
    image[:] = quarters.repeat(4, 0).repeat(8, 1)
    corners = corner + np.array([0 * u, u, u + v, v])
    file = tmp_path / "parallelogram.html"
    uv, faces = [[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]]
    file.write_text(report.report_html(fitted, glb(corners, [normal] * 4, uv, faces, image, 0.8)), "utf-8")

    origin, light = corner + np.array([[4.0, 0.5, 16.0], [-3.0, 5.0, 11.0]])
    forward = corner + 0.4 * u + 0.6 * v - origin
    forward /= np.linalg.norm(forward)
    left = np.cross([0.3, 0.9, 0.2], forward)
    left /= np.linalg.norm(left)
    rotation = np.stack([left, np.cross(forward, left), forward], 1)  # x left, y up, z forward
    fx, fy, cx, cy, width, height = 110.0, 125.0, 37.0, 21.0, 70, 50

    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([-(x - cx) / fx, -(y - cy) / fy, np.ones_like(x)], -1) @ rotation.T
    points = origin + rays * ((corner - origin) @ normal / (rays @ normal))[..., None]
    a, b = np.moveaxis((points - corner) @ np.linalg.pinv(np.stack([u, v], 1)).T, -1, 0)
    to_light = light - points
    distance = np.linalg.norm(to_light, axis=-1)
    colour = srgb_to_linear(quarters / 255)[(b > 0.5).astype(int), (a > 0.5).astype(int)]
    radiance = colour / 0.8 / np.pi * intensity * (to_light @ normal / distance**3)[..., None]
    edge = np.minimum(np.minimum(a, 1 - a) * 5, np.minimum(b, 1 - b) * 4)  # about how far inside
    clear = (edge > 0.4) & (abs(a - 0.5) > 0.1) & (abs(b - 0.5) > 0.1)  # not where colours blend
    truth = images.linear_to_srgb(radiance)
    assert 0.2 < truth[edge > 0].max() < 0.95 and 200 < clear.sum() < 2500

    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = rotation, origin
    shot = open_page(file).evaluate("(photograph) => window.viewer.draw(photograph)", {
        "to_world": to_world.ravel().tolist(), "fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height,
        "light": {"position": light.tolist(), "intensity": intensity.tolist()},
    })  # fmt: skip
    shown = picture(base64.b64decode(shot.split(",")[1]))
    assert shown.shape == (height, width, 3)
    assert np.abs(shown - truth)[clear].max() < 1.6 / 255
    assert shown[edge < -0.2].max() == 0


def rows(n=9, **changes):
    """Rows of a good fit; `changes`: what is different about the fifth."""
    good = [
        {"name": f"{k}.jpg", "psnr": 31 + 0.2 * k, "iou": 0.99, "saturated": 0.0, "shift": (0.1 * (k % 3 - 1), 0.05)}
        for k in range(n)
    ]
    good[4] |= changes
    return [report.PhotographPanel(**row, pictures={}) for row in good]


def test_of_a_good_fit_there_is_nothing_to_say():
    assert report.fit_findings(rows(), 400, 400) == []
    assert report.fit_findings(rows(), 400, 400, None, 0.29) == []
    assert [few.split(",")[0] for few in report.fit_findings(rows(), 9, 9, None, 0.9)] == ["The fit had 9 iterations"]
    assert "41% of the object's light is not" in report.fit_findings(rows(), 400, 400, None, 0.41)[0]
    assert report.fit_findings(rows(psnr=29.0, iou=0.91, saturated=0.249, shift=(0.9, 0.1)), 400, 400) == []
    nothing = [
        report.PhotographPanel("a.png", 30.0, None, 0.0, None, {}),
        report.PhotographPanel("b.png", 12.0, None, 0.0, None, {}),
    ]
    assert report.fit_findings(nothing, 400, 400) == []  # which of two is wrong cannot be told


@pytest.mark.parametrize("changes, words", [
    ({"psnr": 26.0}, ["4.jpg (26.0 dB)", "31.6 dB", "leave"]),
    ({"iou": 0.62}, ["4.jpg (IoU 0.62)", "mask"]),
    ({"saturated": 0.264}, ["4.jpg (26.4%)", "Expose less"]),
    ({"shift": (-1.4, 2.05)}, ["4.jpg (1.4 px to the left and 2.0 px below)", "pose"]),
])  # fmt: skip
def test_one_photograph_that_stands_out_is_named(changes, words):
    (found,) = report.fit_findings(rows(**changes), 400, 400)
    assert all(word in found for word in words) and found.endswith(".")


def test_a_shift_of_all_photographs_is_one_of_the_camera():
    moved = rows()
    for row in moved:
        row.shift = (row.shift[0] + 0.6, row.shift[1] - 1.2)
    (found,) = report.fit_findings(moved, 400, 400)
    assert "0.6 px to the right and 1.1 px above" in found and "cx and cy" in found


def test_an_early_end_is_told():
    (found,) = report.fit_findings(rows(), 130, 400)
    assert "130 of 400" in found and "--resume" in found


def test_of_many_the_worst_are_named():
    many = rows(20)
    for k, row in enumerate(many):
        row.saturated = 0.26 + 0.01 * k
    (found,) = report.fit_findings(many, 400, 400)
    assert found.startswith("19.jpg (45.0%), 18.jpg (44.0%), 17.jpg") and "and 15 more" in found


def test_shifts_are_measured_to_a_fraction_of_a_pixel():
    y, x = np.mgrid[:40, :56]

    def blob(right, below):
        lump = np.exp(-(((x - 24 - right) / 9) ** 2) - ((y - 17 - below) / 5) ** 2)
        return lump[..., None] * [0.3, 0.9, 0.6]

    inside = blob(0, 0)[..., 1] > 0.01
    assert report.shift(blob(1.5, -0.75), blob(0, 0), inside) == pytest.approx((1.5, -0.75), abs=0.06)
    assert report.shift(blob(0, 0), 0 * blob(0, 0), inside) is None


def panel(result, k):
    """The row of photograph `k` in the report."""
    surface = result.drawn(result.ring.subdivisions)
    return report.panel_of(result, report.white(result.ring), k, report.predicted(result, surface, np.array([k]))[0])[0]


def test_a_moved_principal_point_is_found_and_nothing_else_is(fitted, broken_capture):
    good = [panel(fitted, k) for k in range(12)]
    assert not report.fit_findings(good, 500, 500)
    path, edit = broken_capture
    edit('name="cx" value="30.5"', 'name="cx" value="32.5"', count=-1)
    wrong = replace(fitted, capture=load_capture(path))
    moved = [panel(wrong, k) for k in range(12)]
    found = [found for found in report.fit_findings(moved, 50, 50) if "cx and cy" in found]
    assert len(found) == 1 and re.search(
        r"(1\.[5-9]|2\.[0-5]) px to the left( and 0\.[0-2] px \w+)? \(median\)", found[0]
    )


def test_saturated_pixels_are_counted_on_the_object(broken_capture, fitted):
    path, _ = broken_capture
    image = np.array(Image.open(path.parent / "images" / "003.png"))
    mask = np.array(Image.open(path.parent / "masks" / "003.png")) > 127
    image[~mask] = 255
    inside = np.argwhere(mask)
    image[tuple(inside[: len(inside) // 4].T)] = 255
    Image.fromarray(image).save(path.parent / "images" / "003.png")
    assert panel(replace(fitted, capture=load_capture(path)), 3).saturated == pytest.approx(0.25, abs=0.01)


def test_the_bundle_is_whole_small_as_stated_and_can_be_embedded():
    bundle = (VIEWER / "viewer.min.js").read_text("utf-8")
    assert "three.js authors" in bundle and "WITHOUT WARRANTY OF ANY KIND" in bundle
    assert "</script" not in bundle and "<!--" not in bundle
    page = (Path(__file__).parents[1] / "docs" / "reference" / "results-folder.md").read_text("utf-8")
    stated = int(re.search(r"three\.js, (\d+) kB", page)[1])
    assert abs((VIEWER / "viewer.min.js").stat().st_size / 1000 - stated) < 1
    assert "resolved" not in (VIEWER / "package-lock.json").read_text()
