"""What a person does to a page in headless Chromium, through shadow roots: clicks, types, drags, presses keys."""

from __future__ import annotations

import json
import time
from typing import Any

from headless import Page

_FIND = """
globalThis.findAll = (selector, root = document) => {
  const out = [...root.querySelectorAll(selector)];
  for (const element of root.querySelectorAll("*"))
    if (element.shadowRoot) out.push(...globalThis.findAll(selector, element.shadowRoot));
  return out;
};
globalThis.isShown = (e) => e.checkVisibility({visibilityProperty: true}) && e.getClientRects().length > 0;
globalThis.find = (selector, text) => globalThis.findAll(selector).find((e) => globalThis.isShown(e)
  && (text === null || e.textContent.includes(text) || (e.ariaLabel ?? "").includes(text)));
globalThis.textOf = (root) => {
  const walk = (node) => {
    if (node.nodeType === 3) return node.data;
    if (node.nodeType === 1 && ["STYLE", "SCRIPT"].includes(node.tagName)) return "";
    const display = node.nodeType === 1 ? getComputedStyle(node).display : "inline";
    if (display === "none") return "";
    const nodes = [...(node.shadowRoot ?? node).childNodes, ...(node.shadowRoot ? node.childNodes : [])];
    const text = nodes.map(walk).join("");
    return display === "inline" ? text : ` ${text} `;
  };
  return walk(root).replace(/\\s+/g, " ").trim();
};
globalThis.focused = () => {
  let at = document.activeElement;
  while (at?.shadowRoot?.activeElement) at = at.shadowRoot.activeElement;
  return at;
};
"""
_KEYS = {
    "Enter": ("Enter", 13, "\r"),
    "Tab": ("Tab", 9, ""),
    "Escape": ("Escape", 27, ""),
    "ArrowDown": ("ArrowDown", 40, ""),
    "ArrowUp": ("ArrowUp", 38, ""),
    "ArrowLeft": ("ArrowLeft", 37, ""),
    "ArrowRight": ("ArrowRight", 39, ""),
    "Home": ("Home", 36, ""),
    "End": ("End", 35, ""),
    " ": ("Space", 32, " "),
}


class Hands:
    """Acts on one page."""

    def __init__(self, page: Page) -> None:
        self.page = page

    def value(self, expression: str) -> Any:
        """What an expression gives, with findAll(), find(), textOf() and focused() at hand."""
        return self.page.value(f"(() => {{ if (!globalThis.findAll) {{ {_FIND} }} return ({expression}); }})()")

    def wait(self, expression: str, timeout_s: float = 20) -> None:
        end = time.monotonic() + timeout_s
        while not self.value(f"!!({expression})"):
            if time.monotonic() > end:
                raise AssertionError(
                    f"not true after {timeout_s} s: {expression}; {self.page.failures()}; {self.text()}"
                )
            time.sleep(0.05)

    def text(self, selector: str = "body") -> str:
        return self.value(f"textOf(findAll({json.dumps(selector)})[0] ?? document.createElement('i'))")

    def says(self, text: str, selector: str = "body", timeout_s: float = 20) -> None:
        """Waits until a text is to be read."""
        found = f"textOf(findAll({json.dumps(selector)})[0] ?? document.createElement('i'))"
        self.wait(f"{found}.includes({json.dumps(text)})", timeout_s)

    def middle(self, selector: str, text: str | None = None) -> tuple[float, float]:
        """Where it is once it stands still: a picture that arrives, or a dialog that closes, moves what is below it."""
        found = f"find({json.dumps(selector)}, {json.dumps(text)})"
        self.wait(f"{found} && findAll('img').every((e) => e.complete)")
        at = self._middle_of(found)
        for _ in range(200):
            self.value("new Promise((rest) => requestAnimationFrame(() => requestAnimationFrame(rest)))")
            before, at = at, self._middle_of(found)
            if at is not None and at == before:
                return at[0], at[1]
        raise AssertionError(f"{found} never stands still")

    def _middle_of(self, found: str) -> list[float] | None:
        return self.value(
            f"(() => {{ const e = {found}; if (!e) return null; e.scrollIntoView({{block: 'nearest'}});"
            " const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )

    def click(self, selector: str, text: str | None = None) -> None:
        """At the middle of what is shown, by a mouse, so what covers it would be hit instead."""
        self.click_at(*self.middle(selector, text))

    def click_at(self, x: float, y: float) -> None:
        self._mouse("mouseMoved", x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self._mouse(kind, x, y, button="left", clickCount=1)

    def drag(self, x: float, y: float, to_x: float, to_y: float) -> None:
        self._mouse("mouseMoved", x, y)
        self._mouse("mousePressed", x, y, button="left", clickCount=1)
        for k in range(1, 6):
            self._mouse("mouseMoved", x + (to_x - x) * k / 5, y + (to_y - y) * k / 5, button="left", buttons=1)
        self._mouse("mouseReleased", to_x, to_y, button="left", clickCount=1)

    def press(self, *keys: str, shift: bool = False) -> None:
        for key in keys:
            code, number, text = _KEYS.get(key, (key, ord(key.upper()[0]), key))
            more = {"key": key, "code": code, "windowsVirtualKeyCode": number, "modifiers": 8 if shift else 0}
            self.page._call("Input.dispatchKeyEvent", {"type": "keyDown", "text": text, **more})
            self.page._call("Input.dispatchKeyEvent", {"type": "keyUp", **more})

    def type(self, text: str) -> None:
        self.page._call("Input.insertText", {"text": text})

    def resize(self, width: int, height: int, *, mobile: bool = False) -> None:
        self.page._call(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile},
        )
        self.page._call("Emulation.setTouchEmulationEnabled", {"enabled": mobile})

    def colours(self, scheme: str) -> None:
        self.page._call("Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]})

    def go(self, url: str) -> None:
        self.page._call("Page.navigate", {"url": url})

    def _mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.page._call("Input.dispatchMouseEvent", {"type": kind, "x": x, "y": y, **more})
