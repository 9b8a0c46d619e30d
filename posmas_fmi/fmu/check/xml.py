"""XML of strangers: refused if it is not plain, before a parser that resolves things sees it."""

from __future__ import annotations

from xml.parsers import expat

from posmas_fmi.fmu.check.finding import Finding

MAX_SIZE = 512 * 2**20  # bytes
MAX_DEPTH = 64
MAX_ELEMENTS = 5_000_000
_LONGEST = 200  # characters of the parser's message


class _StopError(Exception):
    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code, self.message = code, message


def scan(data: bytes, place: str) -> list[Finding]:
    """Read XML without resolving anything.

    Parameters
    ----------
    data : bytes
    place : str
        Name of the file.

    Returns
    -------
    list of Finding
        A fatal one if the text is not well formed, is not in the encoding that it declares, has a
        document type (and so perhaps entities), or is too large or too deep.

    Examples
    --------
    >>> scan(b"<a><b/></a>", "a.xml")
    []
    >>> scan(b'<!DOCTYPE a [<!ENTITY e "x">]><a>&e;</a>', "a.xml")[0].code
    'xml-dtd'
    """
    if len(data) > MAX_SIZE:
        return [
            Finding(
                "fatal",
                "xml-size",
                place,
                f"expected at most {MAX_SIZE // 2**20} MiB (got {len(data) // 2**20} MiB)",
            )
        ]
    walk = _Walk()
    parser = expat.ParserCreate(None, "}")  # prefixes must be bound, as those who parse it ask
    parser.StartElementHandler = walk.start
    parser.EndElementHandler = walk.end
    parser.StartDoctypeDeclHandler = walk.doctype
    parser.XmlDeclHandler = walk.declaration
    try:
        parser.Parse(data, True)
    except _StopError as stop:
        where = f"{place}:{parser.CurrentLineNumber}"
        return [Finding("fatal", stop.code, where, stop.message)]
    except (expat.ExpatError, ValueError, LookupError) as error:
        where = f"{place}:{parser.CurrentLineNumber}"
        return [_broken(data, walk.encoding, where, str(error)[:_LONGEST])]
    if walk.encoding.lower() not in ("utf-8", "utf8", "us-ascii"):
        message = f"expected UTF-8 (it says {walk.encoding})"
        return [Finding("note", "xml-not-utf8", place, message)]
    return []


def _broken(data: bytes, encoding: str, where: str, said: str) -> Finding:
    try:
        data.decode(encoding)
    except (UnicodeDecodeError, LookupError) as error:
        return Finding(
            "fatal",
            "xml-encoding",
            where,
            f"the file is not in {encoding} as it says ({error})",
            "save the file in UTF-8",
        )
    return Finding("fatal", "xml-malformed", where, f"expected well-formed XML ({said})")


class _Walk:
    """What the parser passes by."""

    def __init__(self) -> None:
        self.depth = self.elements = 0
        self.encoding = "UTF-8"

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        self.elements += 1
        if self.depth > MAX_DEPTH:
            raise _StopError("xml-depth", f"elements are nested deeper than {MAX_DEPTH}")
        if self.elements > MAX_ELEMENTS:
            raise _StopError("xml-elements", f"expected at most {MAX_ELEMENTS} elements")

    def end(self, name: str) -> None:
        self.depth -= 1

    def doctype(self, name: str, system: str | None, public: str | None, internal: bool) -> None:
        raise _StopError(
            "xml-dtd", "a document type is declared: entities could read files or fill the memory"
        )

    def declaration(self, version: str, encoding: str | None, standalone: int) -> None:
        self.encoding = encoding or "UTF-8"
