"""A MkDocs hook that copies repository files into the site, so that links to them work there."""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel

ROOT = Path(__file__).parent
LINK = re.compile(r"\]\(([^)\s#]+)[^)\s]*\)")


class TextFile(File):
    """A file that the site shows unchanged."""

    def is_documentation_page(self) -> bool:
        """Return False, even for Markdown: a page made of it would have links that lead out of the site."""
        return False


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add each file outside docs/ that a page links to, as a text file that a browser can display."""
    for page in files.documentation_pages():
        for link in LINK.findall(page.content_string):
            uri = posixpath.normpath(posixpath.join(posixpath.dirname(page.src_uri), link))
            path = (ROOT / config["docs_dir"] / uri).resolve()
            if uri.startswith("../") and path.is_file() and files.get_file_from_path(uri) is None:
                name = path.relative_to(ROOT)
                file = TextFile(
                    uri,
                    src_dir=None,
                    dest_dir=config["site_dir"],
                    use_directory_urls=False,
                    dest_uri=f"files/{name}.txt",
                    inclusion=InclusionLevel.INCLUDED,  # although it is outside docs/
                )
                file.content_bytes = path.read_bytes()
                files.append(file)
    return files
