"""Headless Chromium for the tests of the HTML page, driven by selenium."""

import importlib.util
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def start(*arguments: str) -> Any:
    """A browser without network access; skips the test where there is none."""
    binary = next(filter(None, map(shutil.which, NAMES)), None)
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no browser: apt-get install chromium chromium-driver")
    if importlib.util.find_spec("selenium") is None:
        pytest.skip("no selenium: pip install selenium")
    from selenium.webdriver import Chrome, ChromeOptions, ChromeService

    options = ChromeOptions()
    options.binary_location = binary
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--hide-scrollbars",
        "--host-resolver-rules=MAP * ~NOTFOUND",
        *arguments,
    ):
        options.add_argument(argument)
    return Chrome(options=options, service=ChromeService(driver))


class Page:
    """A page in the browser, as a user sees it.

    Args:
        driver: selenium's driver.
        path: the file to open.
        size: of the window, in pixels.
    """

    def __init__(
        self, driver: Any, path: Path, size: tuple[int, int] = (1000, 620)
    ) -> None:
        self.driver = driver
        driver.set_window_size(*size)
        driver.get(path.as_uri())
        self.until(
            lambda: self.run(
                "return state.views.length > 0 && state.views.every((v) => !v.draw || "
                "scanOf(v).columns)"
            )
        )
        self.settle()

    def run(self, script: str, *arguments: Any) -> Any:
        """The result of a script in the page."""
        return self.driver.execute_script(script, *arguments)

    def until(self, condition: Callable[[], Any], seconds: float = 60) -> None:
        """Wait for a condition."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "the page did not get there"
            time.sleep(0.05)

    def settle(self) -> None:
        """Wait until the page has drawn twice more."""
        self.driver.execute_async_script(
            "requestAnimationFrame(() => requestAnimationFrame(() => arguments[0]()))"
        )

    def all(self, selector: str) -> list[Any]:
        """The elements that a CSS selector finds."""
        found: list[Any] = self.driver.find_elements("css selector", selector)
        return found

    def texts(self, selector: str) -> list[str]:
        return [found.text for found in self.all(selector)]

    def drag(self, view: int, dx: int, dy: int, shift: bool = False) -> None:
        """Drag the mouse from the centre of a view."""
        from selenium.webdriver import ActionChains, Keys

        actions = ActionChains(self.driver, duration=20)
        if shift:
            actions.key_down(Keys.SHIFT)
        actions.move_to_element(
            self.all(".view canvas")[view]
        ).click_and_hold().move_by_offset(dx, dy).release()
        if shift:
            actions.key_up(Keys.SHIFT)
        actions.perform()
        self.settle()

    def click(self, view: int, x: int, y: int) -> dict[str, str]:
        """Click at a pixel of a view; returns what the page says about the point, {} without
        one."""
        from selenium.webdriver import ActionChains

        canvas = self.all(".view canvas")[view]
        width, height = self.size(view)
        actions = ActionChains(self.driver, duration=0)
        actions.move_to_element_with_offset(
            canvas, x - width // 2, y - height // 2
        ).click().perform()
        self.settle()
        panel = self.all(".view")[view].find_elements("css selector", ".picked dl > *")
        words = [part.text for part in panel if part.is_displayed()]
        return dict(zip(words[::2], words[1::2], strict=True))

    def size(self, view: int) -> tuple[int, int]:
        """Width and height of a view in pixels."""
        width, height = self.run(
            "const c = state.views[arguments[0]].canvas; return [c.clientWidth, c.clientHeight]",
            view,
        )
        return width, height

    def press(self, key: str, shift: bool = False) -> None:
        """Press and release a key."""
        from selenium.webdriver import ActionChains, Keys

        actions = ActionChains(self.driver, duration=0)
        if shift:
            actions.key_down(Keys.SHIFT).send_keys(key).key_up(Keys.SHIFT).perform()
        else:
            actions.send_keys(key).perform()
        self.settle()

    def camera(self) -> dict[str, Any]:
        camera: dict[str, Any] = self.run("return state.camera")
        return camera

    def situation(self) -> dict[str, Any]:
        """Everything that a key could change."""
        situation: dict[str, Any] = self.run("""
            const all = (selector, one) => [...document.querySelectorAll(selector)].map(one);
            return {
                camera: JSON.stringify(state.camera),
                captions: all(".caption", (e) => e.textContent),
                pressed: all("button", (e) => e.getAttribute("aria-pressed")),
                size: state.size,
                picked: all(".picked", (e) => e.hidden ? "" : e.textContent),
            };
        """)
        return situation

    def pixels(self, view: int) -> Any:
        """(H, W, 3) the picture of a view, without its caption."""
        import io

        import numpy as np
        from PIL import Image

        content = self.all(".view canvas")[view].screenshot_as_png
        return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))[70:]

    def errors(self) -> list[str]:
        """Messages of the console since the last call."""
        return [entry["message"] for entry in self.driver.get_log("browser")]


def running(*arguments: str) -> Iterator[Any]:
    """A browser for a fixture."""
    driver = start(*arguments)
    yield driver
    driver.quit()
