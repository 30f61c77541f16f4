from html.parser import HTMLParser

import pytest

from gsmap.markup import Markup, joined, tag, text_markup

HOSTILE = [
    "<script>alert(1)</script>",
    '" onmouseover="x',
    "' onload='x",
    "</title></style><img src=x onerror=y>",
    "&lt;b&gt; &amp;",
    "]]><!-- -->",
]


class Parsed(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.mark.parametrize("text", HOSTILE)
def test_a_text_stays_a_text(text):
    found = Parsed(tag("p", text, tag("b", [text, None]), title=text).html)
    assert found.tags == [("p", {"title": text}), ("b", {})]
    assert found.text == 2 * text


def test_what_steers_is_shown_as_what_it_is():
    assert text_markup("a\x1b[31m\x00\u202eb\rc\ud800\n").html == r"a\x1b[31m\x00\u202eb\rc\ud800" + "\n"


def test_attributes_are_named_as_in_html():
    assert tag("th", 3, class_="num", aria_label="a", title=None).html == '<th class="num" aria-label="a">3</th>'
    assert tag("meta", name="x").html == '<meta name="x">'


def test_only_markup_goes_in_as_it_is():
    assert joined("<", Markup("<br>"), ["&", None, [tag("i", 1.5)]]).html == "&lt;<br>&amp;<i>1.5</i>"
    assert not joined()
