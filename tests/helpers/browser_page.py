"""A page of the studio in a real Chromium without a window."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# software rendering has to be asked for since Chromium 139; shared memory is small in containers
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage", "--no-sandbox"]
# what Chromium and viser say in every page, without anything being wrong
USUAL = ("THREE.Clock", "GPU stall", "GL Driver Message")


@contextmanager
def open_page(url: str, *, chromium: str = "/usr/bin/chromium", width: int = 1280, height: int = 800) -> Iterator[tuple[Any, list[str]]]:
    """The opened page (playwright's), and the messages of its console, errors and requests to elsewhere as they come."""
    from playwright.sync_api import sync_playwright

    messages: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.on("console", lambda m: m.type in ("error", "warning") and not m.text.startswith(USUAL) and messages.append(m.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.on("request", lambda request: request.url.startswith((url, "data:", "blob:")) or messages.append(f"outside: {request.url}"))
        page.goto(url)
        page.wait_for_selector(".studio", state="attached", timeout=60_000)
        try:
            close = page.get_by_text("Software WebGL rendering detected")
            if close.count():
                page.locator("button.mantine-Notification-closeButton").first.click(timeout=5000)
        except Exception:  # the notice is viser's; without it the picture is the same
            pass
        yield page, messages
        browser.close()
