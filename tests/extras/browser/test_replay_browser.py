"""The replay as a person uses it: a real browser opens the file and works every control."""

from __future__ import annotations

import base64
import io
import json
import time

import pytest
import torch
from PIL import Image

from marl_explore import ArenaConfig
from marl_explore.cli import explore
from marl_explore.core.frontier import frontier_mask
from marl_explore.evaluation.episodes import watch
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.replay import write_replay
from marl_explore.utils.palette import COLORS

CONFIG = ArenaConfig()
POLICIES = ("nearest-timer", "random")
CODES = {"unknown": -1, "free": 0, "obstacle": 1, "frontier": 2}
LAYERS = ("Trails", "Links", "Frontiers", "Arrows", "Sight")
STEP = 9  # a step with something of every layer to see


@pytest.fixture(scope="module")
def episodes():
    return {name: watch(find_policy(name, CONFIG), CONFIG, steps=60) for name in POLICIES}


@pytest.fixture(scope="module")
def path(episodes, tmp_path_factory):
    return write_replay(episodes, tmp_path_factory.mktemp("replay") / "r.html", config=CONFIG)


class Page:
    """What a person sees of the page and does to it."""

    def __init__(self, driver):
        self.driver = driver

    def find(self, selector):
        return self.driver.find_element("css selector", selector)

    def click(self, selector):
        self.find(selector).click()

    def chip(self, group, text):
        chips = self.driver.find_elements("css selector", f"#{group} > *")
        return next(chip for chip in chips if chip.text == text)

    def pressed(self, group):
        return self.find(f'#{group} [aria-pressed="true"]').text

    def keys(self, *keys):
        from selenium.webdriver import ActionChains

        for key in keys:
            ActionChains(self.driver).send_keys(key).perform()

    @property
    def step(self):
        return int(self.find("#step").text.split(" / ")[0])

    @property
    def last(self):
        return int(self.find("#step").text.split(" / ")[1])

    @property
    def playing(self):
        return self.find("#play").get_attribute("aria-label") == "Pause"

    def wait(self, condition):
        from selenium.webdriver.support.ui import WebDriverWait

        WebDriverWait(self.driver, 20, 0.05).until(lambda _: condition())

    @property
    def picture(self):
        return self.driver.execute_script("return document.getElementById('canvas').toDataURL()")

    def scrub(self, step):
        script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'))"
        self.driver.execute_script(script, self.find("#scrub"), step)

    def show_only(self, *layers):
        for name in LAYERS:
            box = self.chip("layers", name).find_element("tag name", "input")
            if box.is_selected() != (name in layers):
                box.click()

    def colors(self, places):
        """Colours of the canvas at places (row, column) measured in cells."""
        png = base64.b64decode(self.picture.partition(",")[2])
        with Image.open(io.BytesIO(png)) as image:
            scale = image.width / CONFIG.width
            at = [(int(column * scale), int(row * scale)) for row, column in places]
            return ["#{:02x}{:02x}{:02x}".format(*image.getpixel(place)[:3]) for place in at]

    def cells(self):
        """Codes of the cells as their upper left parts are coloured, int8 [H, W]."""
        read = "return getComputedStyle(document.body).getPropertyValue('--' + arguments[0])"
        codes = {
            _full(self.driver.execute_script(read, name)): code for name, code in CODES.items()
        }
        places = [(r + 0.1, c + 0.1) for r in range(CONFIG.height) for c in range(CONFIG.width)]
        shown = [codes[color] for color in self.colors(places)]
        return torch.tensor(shown, dtype=torch.int8).view(CONFIG.height, CONFIG.width)


def _full(color):
    """#rrggbb for a CSS colour that may be #rgb."""
    return color if len(color) == 7 else "#" + "".join(2 * digit for digit in color[1:])


@pytest.fixture
def page(browser, path):
    browser.get_log("browser")
    browser.get(path.as_uri())
    yield Page(browser)
    assert browser.get_log("browser") == []


def view_of(step, view):
    """The map a view shows, int8 [H, W]."""
    maps = step["agents", "map"][0]
    whole = {"Truth": step["obstacles"][0].to(torch.int8), "Merged": maps.amax(0)}
    return whole[view] if view in whole else maps[int(view)]


def test_it_opens_from_disk_without_any_request(browser, path):
    browser.get_log("performance")
    browser.get(path.as_uri())
    page = Page(browser)
    page.click("#last")
    assert (page.step, browser.title) == (page.last, "nearest-timer, random: exploration replay")
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    sent = [m["params"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    asked = [params["request"]["url"] for params in sent]
    assert [url for url in asked if not url.startswith("data:")] == [path.as_uri()]


def test_play_advances_and_pause_stops(page):
    first = page.picture
    page.click("#play")
    assert page.playing
    page.wait(lambda: page.step >= 2)
    page.click("#play")
    step = page.step
    assert not page.playing
    time.sleep(0.4)
    assert page.step == step
    assert page.picture != first


def test_play_ends_at_the_end_and_then_starts_anew(page):
    page.scrub(page.last - 1)
    page.click("#play")
    page.wait(lambda: not page.playing)
    assert page.step == page.last
    page.click("#play")
    assert page.step < page.last


def test_steps_and_scrub(page):
    seen = [page.picture]
    for button, step in (("forward", 1), ("forward", 2), ("back", 1), ("last", page.last)):
        page.click(f"#{button}")
        assert page.step == step
        seen.append(page.picture)
    assert seen[1] == seen[3]
    assert len(set(seen)) == 4
    page.click("#first")
    assert page.step == 0
    page.click("#back")
    assert (page.step, page.picture) == (0, seen[0])
    page.scrub(2)
    assert (page.step, page.picture) == (2, seen[2])


def test_scrub_bar_follows_the_mouse(page):
    from selenium.webdriver import ActionChains

    bar = page.find("#scrub")
    half = bar.size["width"] // 2
    ActionChains(page.driver).move_to_element(bar).click().perform()
    assert abs(page.step - page.last / 2) <= 1
    ActionChains(page.driver).click_and_hold(bar).move_by_offset(half, 0).release().perform()
    assert page.step == page.last


def test_speed_is_changed_and_kept_within_bounds(page):
    speeds = []
    for _ in range(4):
        page.click("#faster")
        speeds.append(page.find("#speed").text)
    assert speeds == ["16 steps/s", "32 steps/s", "32 steps/s", "32 steps/s"]
    page.click("#play")
    time.sleep(0.4)
    fast = page.step
    page.click("#slower")
    assert page.playing
    page.click("#play")
    page.click("#first")
    for _ in range(6):
        page.click("#slower")
    assert page.find("#speed").text == "1 steps/s"
    page.click("#play")
    time.sleep(0.4)
    assert page.step < fast / 2


def test_every_view_shows_what_was_recorded(page, episodes):
    page.show_only()
    for step in (0, STEP, page.last):
        page.scrub(step)
        for view in ("Truth", "Merged", "0", "1", "2", "3"):
            page.chip("views", view).click()
            assert page.pressed("views") == view
            shown = view_of(episodes["nearest-timer"][step], view)
            assert torch.equal(page.cells(), shown), (step, view)


def test_frontiers_are_those_of_the_shown_map(page, episodes):
    page.show_only("Frontiers")
    page.scrub(STEP)
    for view in ("Truth", "Merged", "0", "3"):
        page.chip("views", view).click()
        shown = view_of(episodes["nearest-timer"][STEP], view)
        assert torch.equal(page.cells() == CODES["frontier"], frontier_mask(shown)), view


def test_every_layer_can_be_hidden_and_shown(page, episodes):
    merging = [bool(step["agents", "merged"].any()) for step in episodes["nearest-timer"]]
    page.scrub(merging.index(True, 3))
    whole = page.picture
    for layer in LAYERS:
        page.chip("layers", layer).click()
        assert page.picture != whole, layer
        page.chip("layers", layer).click()
        assert page.picture == whole, layer


def test_robots_stand_where_they_stood_in_their_colors(page, episodes):
    page.show_only()
    page.scrub(STEP)
    position = episodes["nearest-timer"][STEP]["agents", "position"][0].tolist()
    discs = page.colors([(row + 0.25, column + 0.5) for row, column in position])
    assert discs == [color.lower() for color in COLORS[: CONFIG.num_agents]]


def test_numbers_beside_the_canvas(page, episodes):
    page.click("#last")
    assert page.find("#largest").text == "100.0 %"
    step = episodes["nearest-timer"][-1]["agents"]
    rows = [row.text for row in page.driver.find_elements("css selector", "#robots tr")]
    names = ["N", "NE", "E", "SE", "S", "SW", "W", "NW", "stay", "communicate"]
    for robot, row in enumerate(rows):
        assert row.startswith(f"{robot} ")
        assert f"{names[step['action'][0, robot]]}" in row
        assert ("refused" in row) == bool(step["dangerous"][0, robot])
    page.click("#first")
    assert [row.text[-1] for row in page.driver.find_elements("css selector", "#robots tr")] == [
        "\u2013"
    ] * 4
    refused = [bool(s["agents", "dangerous"].any()) for s in episodes["random"]].index(True)
    page.chip("policies", "random").click()
    page.scrub(refused)
    assert "refused" in page.find("#robots .refused").text


def test_policies_are_switched_at_the_same_step(page):
    page.scrub(STEP)
    before = page.picture
    page.chip("policies", "random").click()
    assert (page.pressed("policies"), page.step) == ("random", STEP)
    assert "random" in page.find("#arena").text
    assert page.picture != before
    page.keys("p")
    assert (page.pressed("policies"), page.picture) == ("nearest-timer", before)


def test_keyboard(page):
    from selenium.webdriver import Keys

    page.keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ARROW_LEFT)
    assert page.step == 1
    page.keys(Keys.END)
    assert page.step == page.last
    page.keys(Keys.HOME)
    assert page.step == 0
    page.keys("+", "+", "-")
    assert page.find("#speed").text == "16 steps/s"
    page.keys(" ")
    assert page.playing
    page.keys(" ")
    assert not page.playing
    for key, view in (("t", "Truth"), ("m", "Merged"), ("0", "0"), ("3", "3"), ("7", "3")):
        page.keys(key)
        assert page.pressed("views") == view


@pytest.mark.parametrize("used", ["#forward", "#scrub", "#layers input", "#views button"])
def test_keys_go_to_the_player_after_a_click_anywhere(page, used):
    page.click(used)
    page.click("#first")
    page.click(used)
    step = page.step
    from selenium.webdriver import Keys

    page.keys(Keys.ARROW_RIGHT)
    assert page.step == step + 1
    page.keys(" ")
    assert page.playing


def test_a_focused_button_is_pressed_by_space(page):
    page.driver.execute_script("document.getElementById('forward').focus()")
    page.keys(" ")
    assert (page.step, page.playing) == (1, False)


def test_dragging_the_mouse_over_the_canvas_scrubs_and_a_click_plays(page):
    from selenium.webdriver import ActionChains

    canvas = page.find("#canvas")
    half = canvas.size["width"] // 2
    ActionChains(page.driver).click_and_hold(canvas).move_by_offset(half, 0).release().perform()
    assert abs(page.step - page.last / 2) <= 1
    assert not page.playing
    ActionChains(page.driver).click(canvas).perform()
    assert page.playing


def touch(driver, kind, *points):
    points = [{"x": x, "y": y} for x, y in points]
    driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


@pytest.fixture
def phone(browser, path):
    size = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    browser.get(path.as_uri())
    yield Page(browser)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert browser.get_log("browser") == []


def test_touch_drags_and_taps(phone):
    driver = phone.driver
    box = phone.find("#canvas").rect
    x, y = box["x"] + 20, box["y"] + box["height"] / 2
    touch(driver, "touchStart", (x, y))
    for part in (0.1, 0.3, 0.5):
        touch(driver, "touchMove", (x + part * box["width"], y))
    touch(driver, "touchEnd")
    assert abs(phone.step - phone.last / 2) <= 1
    assert not phone.playing
    touch(driver, "touchStart", (x, y))
    touch(driver, "touchEnd")
    assert phone.playing


def test_a_phone_shows_the_page_without_scrolling_sideways(phone):
    script = "return [document.documentElement.scrollWidth, innerWidth]"
    scroll, width = phone.driver.execute_script(script)
    assert scroll <= width == 390
    assert phone.find("#canvas").rect["width"] > 300


def test_dark_mode_has_colors_of_its_own(page):
    light = page.picture
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": dark})
    page.wait(lambda: page.picture != light)
    page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_the_page_of_an_explored_map_opens_and_ends_with_all_of_it_known(browser, tmp_path):
    (tmp_path / "hall.txt").write_text("........\n.##..#..\n......#.\n")
    words = ("--robots", "2", "--policy", "nearest-timer", "--out", str(tmp_path / "out"))
    explore.run(explore.parse([str(tmp_path / "hall.txt"), *words]))
    browser.get((tmp_path / "out" / "hall.html").as_uri())
    page = Page(browser)
    browser.execute_script(
        "const s = document.querySelector('#scrub'); s.value = s.max;"
        "s.dispatchEvent(new Event('input'))"
    )
    page.wait(lambda: page.step == page.last > 0)
    assert "100" in browser.find_element("css selector", "body").text
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
