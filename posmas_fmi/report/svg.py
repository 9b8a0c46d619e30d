"""One look for all figures, and matplotlib's SVG made fit to stand inside an HTML page."""

from __future__ import annotations

import contextlib
import io
import math
import re
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which readers with any colour vision can tell apart; its yellow is left
# out because it is too pale for a line on white. Black belongs to the leader.
BLUE, VERMILION, GREEN, PURPLE = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
SKY, ORANGE, BLACK, GREY = "#56b4e9", "#e69f00", "#1a1a1a", "#6b7280"
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILION)

_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # text stays text: searchable, and set in the font of the page
    "svg.hashsalt": "posmas-fmi",
    "text.parse_math": False,  # names of agents may contain a dollar sign
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.labelcolor": "#374151",
    "axes.edgecolor": "#9ca3af",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.unicode_minus": True,
    "axes.xmargin": 0.01,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.6,
    "xtick.color": "#9ca3af",
    "ytick.color": "#9ca3af",
    "xtick.labelcolor": "#374151",
    "ytick.labelcolor": "#374151",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
    "figure.constrained_layout.use": True,
}

_SVG = "{http://www.w3.org/2000/svg}"
_REFERENCE = re.compile(r"#([A-Za-z_][\w.-]*)")


@contextlib.contextmanager
def look() -> Iterator[None]:
    """Draw and save in here: neither reads nor changes the settings of the user."""
    import matplotlib

    with matplotlib.rc_context(), warnings.catch_warnings():
        # a name in a script that the measuring font lacks is still set in the reader's font
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)  # type: ignore[arg-type, unused-ignore]
        yield


def power_of_ten(value: float, _position: int = 0) -> str:
    """Write a power of ten without mathtext, as a matplotlib tick formatter.

    Examples
    --------
    >>> power_of_ten(1e-5), power_of_ten(-100.0), power_of_ten(0.0)
    ('10⁻⁵', '−100', '0')
    """
    if value == 0:
        return "0"
    exponent = round(math.log10(abs(value)))
    sign = "−" if value < 0 else ""
    if -1 <= exponent <= 2:
        return f"{sign}{10.0**exponent:g}"
    return f"{sign}10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def to_svg(figure: Figure, name: str, alt: str) -> str:
    """Return a figure as an ``<svg>`` element for an HTML page.

    Parameters
    ----------
    figure : Figure
    name : str
        Unique on the page; becomes the prefix of every id.
    alt : str
        What the figure shows, for those who cannot see it.

    Returns
    -------
    str
        Scales with its container; holds no reference to anything outside.
    """
    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(buffer, format="svg", transparent=True, metadata=no_metadata)
    root = ElementTree.fromstring(buffer.getvalue().encode("utf-8"))
    _strip(root)
    used = {
        reference
        for element in root.iter()
        for key, value in element.attrib.items()
        if key == "href" or "url(" in value
        for reference in _REFERENCE.findall(value)
    }
    for element in root.iter():
        _rename(element, name, used)
    for key in ("width", "height", "version"):
        root.attrib.pop(key, None)
    root.set("class", "plot")
    root.set("role", "img")
    root.set("aria-label", alt)
    return ElementTree.tostring(root, encoding="unicode")


def _strip(root: ElementTree.Element) -> None:
    """Drop namespaces (HTML knows SVG), styles that would leak into the page, and metadata."""
    for element in root.iter():
        element.tag = element.tag.removeprefix(_SVG)
        for key in list(element.attrib):
            if "}" in key:
                element.set(key.rpartition("}")[2], element.attrib.pop(key))
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag == "style" or child.tag.endswith("metadata"):
                parent.remove(child)


def _rename(element: ElementTree.Element, name: str, used: set[str]) -> None:
    for key, value in list(element.attrib.items()):
        if key == "id":
            if value in used:
                element.set("id", f"{name}-{value}")
            else:
                del element.attrib["id"]
        elif (key == "href" and value.startswith("#")) or "url(#" in value:
            element.set(key, _REFERENCE.sub(rf"#{name}-\1", value))
