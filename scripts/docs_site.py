"""What MkDocs needs besides `docs/`: files outside of it, and equations.

Pages link to files of the repository as a reader of the repository would, and write
equations between dollar signs. On the site such files are copied along, and equations
become MathML, which browsers show without a script.
"""

import re
from pathlib import Path
from typing import Any

_OUTSIDE = re.compile(r"(\]\()\.\./([^)#\s]+)")
_LINK = re.compile(r"\]\(([^)#\s:]+)\)")
_CODE = re.compile(r"(```.*?```|`[^`\n]+`|(?<=\n) {4}[^\n]*)", re.S)
_DISPLAY = re.compile(r"\$\$(.+?)\$\$", re.S)
_INLINE = re.compile(r"\$([^$\n]+)\$")


def on_files(files: Any, *, config: Any) -> Any:
    """Adds the files outside `docs/` that pages link to, and what those need."""
    root = Path(config.docs_dir).parent
    wanted = {
        name
        for page in files.documentation_pages()
        for _, name in _OUTSIDE.findall(page.content_string)
    }
    for name in sorted(wanted):
        _add(files, config, root, name)
        if name.endswith(".md"):
            for near in _LINK.findall((root / name).read_text(encoding="utf-8")):
                _add(files, config, root, str(Path(name).parent / near))
    return files


def _add(files: Any, config: Any, root: Path, name: str) -> None:
    from mkdocs.structure.files import (  # pyright: ignore[reportMissingImports]
        File,
        InclusionLevel,
    )

    if files.get_file_from_path(name) is None:
        found = str(root / name)
        kind = InclusionLevel.NOT_IN_NAV
        files.append(File.generated(config, name, abs_src_path=found, inclusion=kind))


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links into the copies, and equations as MathML."""
    parts = _CODE.split(_OUTSIDE.sub(r"\1\2", markdown))
    parts[::2] = map(equations, parts[::2])
    return "".join(parts)


def equations(text: str) -> str:
    """MathML in the place of ``$$...$$`` and ``$...$``."""
    if "$" not in text:
        return text
    from latex2mathml.converter import (  # pyright: ignore[reportMissingImports]
        convert,
    )

    def display(found: re.Match[str]) -> str:
        return f"<div>{convert(found[1].strip(), display='block')}</div>"

    text = _DISPLAY.sub(display, text)
    return _INLINE.sub(lambda found: convert(found[1]), text)
