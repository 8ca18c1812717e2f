"""The page in headless Chromium: the player moves, choices change traces, tables sort, no hostile name runs."""

import math
import re
import shutil
from collections.abc import Iterator

import numpy as np
import pytest
import xarray as xr
from diagnosed import diagnosed
from playwright.sync_api import Browser, Page, sync_playwright
from synthetic import synthetic_run

from driftjax.report.diagnosis_page import diagnosis_page
from driftjax.report.html import quantity
from driftjax.report.learn import learn_page
from driftjax.report.log_comparison import log_comparison_page
from driftjax.store import DIAGNOSIS, RunFolder

HOSTILE = "</script><script>window.hacked = 1</script><img src=x onerror='window.hacked = 2'>&amp;\u2028"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update",
         "--disable-sync", "--no-first-run"]  # fmt: skip

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium; apt-get install -y chromium")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def learnt(tmp_path_factory) -> RunFolder:
    """A run of two plants, one of them with a hostile name, and a hostile car."""
    run = synthetic_run(tmp_path_factory.mktemp("runs") / "learn", 2, ("pursuit", "nominal", "gpr-1", "explore-1"))
    for name in run.finished():
        data = run.read_stage(name)
        plants = ["sedan_0_0" if plant == "sedan_0_0" else HOSTILE for plant in data["plant"].values.tolist()]
        run.write_stage(name, data.assign_coords(plant=("lane", np.array(plants, object))), b"")
    run = RunFolder.open(run.path)
    run.config["car"] = HOSTILE
    (run.path / "report.html").write_text(learn_page(run, []), encoding="utf-8")
    return run


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> RunFolder:
    """A diagnosis in which one run has a hostile name."""
    run = diagnosed(tmp_path_factory.mktemp("runs") / "diagnose")
    data = run.read_dataset("diagnosis.nc")
    run.write_dataset("diagnosis.nc", data.assign_coords(panel=np.array(["drift2", HOSTILE], object)))
    assert set(DIAGNOSIS) == set(data.variables)
    (run.path / "report.html").write_text(diagnosis_page(run, []), encoding="utf-8")
    return run


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> RunFolder:
    """A comparison of two logs with three differences, one of them with a hostile name."""
    values = {"a": 0.0, "a_error": 0.1, "b": 0.0, "b_error": 0.1, "unit": "1", "at_bound": False}
    one = {"rivals": {HOSTILE: 0.1}, "probability": 0.9, "p_value": 2e-5, "family": "tyres"}
    sizes = {"friction": -0.5, HOSTILE: 10.0, "mass": 2.0}
    sized = lambda size: {"p": values | {"difference": size, "ci95": [size - 1, size + 1]}}
    differences = [one | {"effect": name, "parameters": sized(size)} for name, size in sizes.items()]
    content = {"verdict": "NAMED", "sentence": HOSTILE, "differences": differences, "gap": None, "data": {}}
    content["overlap"] = {"V": {"first": [1.0, 2.0], "second": [1.5, 2.5], "share": 0.5}}
    run = RunFolder.create(tmp_path_factory.mktemp("runs") / "compare", {"vehicle": {"name": HOSTILE}}, "compare")
    (run.path / "report.html").write_text(log_comparison_page(run, content, []), encoding="utf-8")
    return run


@pytest.fixture
def show(browser):
    """Open a run's page; at the end no error may be in the console and nothing else requested than the file."""
    wrong, contexts = [], []

    def opened(run: RunFolder, drawn: str = "#player svg path", **options) -> Page:
        contexts.append(browser.new_context(**options))
        page, url = contexts[-1].new_page(), (run.path / "report.html").as_uri()
        page.on("console", lambda message: wrong.append(message.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: wrong.append(request.url) if request.url != url else None)
        page.goto(url)
        page.wait_for_selector(drawn)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert wrong == []


def state(page: Page) -> dict[str, str]:
    return page.evaluate("({...document.getElementById('player').dataset})")


def curves(page: Page, trace: str) -> list[str]:
    paths = page.locator(f"[data-trace='{trace}'] path.line")
    return [path.get_attribute("d") or "" for path in paths.all()]


def picture(page: Page) -> str:
    return page.evaluate("document.querySelector('#player canvas').toDataURL()")


def lap(run: RunFolder, stage: str, lane: int) -> xr.Dataset:
    return run.read_stage(stage).isel(lane=lane)


def test_scrubbing_moves_the_car_to_where_the_file_says(show, learnt):
    page = show(learnt)
    first = state(page), picture(page)
    page.keyboard.press("Shift+ArrowRight")
    second = state(page), picture(page)
    assert float(second[0]["time"]) == pytest.approx(float(first[0]["time"]) + 0.5, abs=2e-3)
    assert second[1] != first[1], "the picture must change"
    one, t = lap(learnt, "explore-1", 0), float(second[0]["time"])
    assert second[0]["car"] == "explored 1" and second[0]["ghost"] == "nominal MPC"
    for shown, name, data in (("x", "x", one), ("y", "y", one), ("ghostX", "x", lap(learnt, "nominal", 0))):
        assert float(second[0][shown]) == pytest.approx(np.interp(t, one["t"], data[name]), abs=0.02)
    page.get_by_role("slider", name="time").fill(page.get_by_role("slider").get_attribute("min") or "")
    assert float(state(page)["time"]) < float(first[0]["time"])


def test_dragging_on_a_trace_scrubs(show, learnt):
    page = show(learnt)
    before, chart = float(state(page)["time"]), page.locator("[data-trace='beta'] svg")
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    assert box
    page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.up()
    assert float(state(page)["time"]) > before + 1
    at = float(page.locator("[data-trace='V'] .cursor").get_attribute("x1") or "nan")
    assert at == pytest.approx(0.9 * box["width"], abs=3), "the cursor of the other traces goes along"


def test_a_finger_that_drags_on_a_trace_scrubs_all_the_way(show, learnt):
    """Without a touch action of its own the browser takes the drag for scrolling after the first move."""
    page = show(learnt, viewport={"width": 390, "height": 800}, has_touch=True, is_mobile=True)
    chart = page.locator("[data-trace='beta'] svg")
    chart.scroll_into_view_if_needed()
    box, touch = chart.bounding_box(), page.context.new_cdp_session(page)
    assert box
    place = lambda share: [{"x": box["x"] + share * box["width"], "y": box["y"] + 40}]
    touch.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": place(0.3)})
    for share in np.linspace(0.35, 0.9, 12):
        touch.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": place(share)})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    at = float(page.locator("[data-trace='V'] .cursor").get_attribute("x1") or "nan")
    assert at == pytest.approx(0.9 * box["width"], abs=3)


def test_space_plays_and_stops(show, learnt):
    page = show(learnt)
    page.keyboard.press("Home")
    start = state(page)["time"]
    page.keyboard.press("Space")
    page.wait_for_selector(f"#player:not([data-time='{start}'])")
    assert float(state(page)["time"]) > float(start)
    page.keyboard.press("Space")
    assert page.get_by_role("button", name="Play").count() == 1


def test_another_plant_or_lap_has_other_traces(show, learnt):
    page = show(learnt)
    before = curves(page, "e")
    assert len(before) == 2 and all(before)
    page.get_by_label("Plant or run").select_option(index=1)
    other = curves(page, "e")
    assert state(page)["group"] == f"plant {HOSTILE}" and other != before
    page.get_by_label("Car", exact=True).select_option(label="GPR lap 1")
    assert curves(page, "e")[1] != other[1]
    page.get_by_label("Ghost").select_option(label="none")
    assert len(curves(page, "e")) == 1 and state(page)["ghostX"] == ""


def test_the_uncertainty_is_drawn_where_the_lap_has_it(show, learnt):
    page = show(learnt)
    with_band = picture(page)
    page.get_by_label("GP uncertainty").select_option("")
    assert picture(page) != with_band
    page.get_by_label("Car", exact=True).select_option(label="nominal MPC")
    assert not page.get_by_label("GP uncertainty").is_visible()


def test_tables_sort_by_number_and_back(show, learnt):
    page = show(learnt)
    assert HOSTILE in page.evaluate("document.querySelector('h1').textContent")
    table = page.locator("#learning table")
    column = lambda: table.locator("tbody tr td:nth-child(3)").evaluate_all(
        "cells => cells.map(cell => Number(cell.dataset.value))"
    )
    original, head = column(), table.get_by_role("button", name="lateral error [m]")
    head.click()
    assert column() == sorted(original) != original
    assert table.locator("th[aria-sort='ascending']").count() == 1
    head.click()
    assert column() == sorted(original, reverse=True)
    head.click()
    assert column() == original


def test_measured_and_predicted_part_as_the_file_says(show, measured):
    page = show(measured)
    data, now = measured.read_dataset("diagnosis.nc").isel(panel=0), state(page)
    assert now["car"] == "measured" and now["ghost"] == "predicted, nominal"
    page.keyboard.press("ArrowRight")
    x, y = (float(state(page)[name]) for name in ("x", "y"))
    until = data["sample_time"].values <= float(state(page)["time"]) + 1e-9
    V, beta, r = data["measured"].values[until].T
    course = np.concatenate([[0], np.cumsum((r[1:] + r[:-1]) / 2 * 0.01)]) + beta
    assert np.hypot(x - 0.01 * (V * np.cos(course)).sum(), y - 0.01 * (V * np.sin(course)).sum()) < 0.3
    apart = [float(state(page)[f"ghost{axis}"]) - float(state(page)[axis.lower()]) for axis in "XY"]
    page.get_by_label("Ghost").select_option(label="predicted, extended")
    close = [float(state(page)[f"ghost{axis}"]) - float(state(page)[axis.lower()]) for axis in "XY"]
    assert math.hypot(*close) < 0.02 < math.hypot(*apart)


def test_a_diagnosis_shows_shares_causes_and_residual_forces(show, measured):
    page = show(measured)
    assert page.locator("#waterfall svg").get_attribute("aria-label") == (
        "nominal car 100 %, friction_rear 80 %, left 20 %"
    )
    assert page.locator("#cause-0 svg circle").count() == 6  # three models of V and beta; r lacks that horizon
    drawn = lambda: page.locator("#forces path").first.get_attribute("d")
    seen = set()
    for force in ("drive force", "rear lateral force"):
        page.get_by_label("Residual", exact=True).select_option(label=force)
        seen.add(drawn())
    assert len(seen) == 2
    page.get_by_label("over", exact=True).select_option("speed")
    assert "speed [m/s]" in (page.locator("#forces svg").text_content() or "")
    assert page.locator("#curves svg").count() == 3


def test_every_page_is_legible_safe_and_says_where_its_numbers_are_from(show, learnt, measured):
    for run, group in ((learnt, f"plant {HOSTILE}"), (measured, HOSTILE)):
        page = show(run, viewport={"width": 390, "height": 800}, color_scheme="light")
        options = page.get_by_label("Plant or run").locator("option").evaluate_all("all => all.map(one => one.value)")
        assert group in options
        assert page.evaluate("window.hacked") is None and page.locator("img").count() == 0
        cells = page.locator("td[data-value]").evaluate_all("cells => cells.map(cell => cell.title)")
        assert len(cells) > 10 and all(re.match(r"(results|diagnosis)\.(json|nc): ", title) for title in cells)
        nameless = page.locator("svg[role=img], canvas, select, input, [role=region], [role=group]").evaluate_all(
            "all => all.filter(one => !one.getAttribute('aria-label')).map(one => one.outerHTML)"
        )
        assert nameless == []
        assert "sideslip" in (page.get_by_role("slider").get_attribute("aria-valuetext") or "")
        assert page.evaluate("document.documentElement.scrollWidth") <= 390, "a phone scrolls down only"
        light = shade(page), picture(page)
        page.emulate_media(color_scheme="dark")
        assert light[0] > 200 > 60 > shade(page)
        # The player redraws on the media query's event, which the browser delivers with its next frame.
        page.wait_for_function(
            "before => document.querySelector('#player canvas').toDataURL() !== before", arg=light[1]
        )


def test_a_comparison_of_logs_is_safe_too_and_sorts_by_size(show, compared):
    page = show(compared, drawn="th button", viewport={"width": 390, "height": 800})
    assert page.evaluate("window.hacked") is None and page.locator("img").count() == 0
    assert page.locator(".lead").text_content() == HOSTILE
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.get_by_role("button", name="B less A").click()
    shown = page.locator("table").first.locator("tbody tr td:nth-child(4)").all_text_contents()
    assert shown == ["-0.5 [-1.5, 0.5]", "2 [1, 3]", "10 [9, 11]"]


def test_a_cell_is_sorted_by_the_number_that_its_text_begins_with():
    texts = {
        "1.16 [1.11, 1.21]": 1.16,
        "-0.33": -0.33,
        "97 % [79, 99]": 97.0,
        "2e-06 1/W": 2e-6,
        "-": None,
        "3rd": None,
    }
    assert {text: quantity(text, "here").value for text in texts} == texts


def shade(page: Page) -> float:
    """Mean of red, green and blue of the background, 0 to 255."""
    colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
    return float(np.mean([int(v) for v in re.findall(r"\d+", colour)[:3]]))
