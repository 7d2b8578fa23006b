"""Check a built site: `python docs/site/check_site.py FOLDER`. Every link inside it leads somewhere, and nothing that a
browser loads by itself comes from elsewhere."""

import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

from lxml import html

_LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "video": "src"}
_NOT_LOADED = {"canonical", "next", "prev", "index", "search", "author", "copyright"}  # relations of `link`


def problems(site: Path) -> Iterator[str]:
    """One line for each link that leads nowhere, and for each thing that would be loaded from outside."""
    pages = {path: html.parse(str(path)).getroot() for path in sorted(site.rglob("*.html"))}
    anchors = {path.resolve(): {*page.xpath("//@id"), *page.xpath("//a/@name")} for path, page in pages.items()}
    for path, page in pages.items():
        told = path.relative_to(site)
        for tag, key in _LOADED.items():
            for element in page.iter(tag):
                address = urlsplit(element.get(key) or "")
                wanted = element.get("rel") not in _NOT_LOADED
                if wanted and (address.netloc or address.scheme not in ("", "data")):
                    yield f"{told}: loads {address.geturl()}"
        for link in page.iter("a", "img"):
            address = urlsplit(link.get("href") or link.get("src") or "")
            if address.scheme or address.netloc:
                continue
            place = (path.parent / unquote(address.path)).resolve() if address.path else path.resolve()
            if not place.exists():
                yield f"{told}: {address.geturl()} leads nowhere"
            elif address.fragment and place in anchors and unquote(address.fragment) not in anchors[place]:
                yield f"{told}: {address.geturl()}: no such place on that page"


if __name__ == "__main__":
    found = list(problems(Path(sys.argv[1])))
    print("\n".join(found), file=sys.stderr)
    sys.exit(1 if found else 0)
