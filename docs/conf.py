"""Sphinx configuration: `make docs` generates the reference, executes chapters and gallery, and
needs no network to be built or read."""

import os
import re
import sys
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from matplotlib.figure import Figure
from sphinx.application import Sphinx
from sphinx_gallery.scrapers import figure_rst, matplotlib_scraper

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

project, author, copyright = "torchsoft", "the torchsoft authors", "the torchsoft authors"
version = release = installed("torchsoft")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
suppress_warnings = ["config.cache", "myst-nb.lexer"]
exclude_patterns = ["_build", "gallery/*.ipynb", "gallery/*.py", "gallery/*.md5", "**/*.zip"]

html_theme = "furo"
html_title = "torchsoft"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_show_sphinx = html_show_copyright = html_show_sourcelink = False
html_copy_source = False
pygments_style, pygments_dark_style = "friendly", "native"
copybutton_exclude = ".linenos, .gp, .go"

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence", "attrs_inline"]
myst_heading_anchors = 4
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

autodoc_default_options = {"members": True, "exclude-members": "model_config"}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_use_type_comments = False
autodoc_preserve_defaults = True


def figures(block: Any, found: dict[str, Any], configuration: dict[str, Any]) -> str:
    """Pictures of matplotlib's pyplot, and of the `Figure`s that a script has made without it."""
    text = matplotlib_scraper(block, found, configuration)
    seen, paths = found.setdefault("figures", set()), []
    for value in found["example_globals"].values():
        own = isinstance(value, Figure) and getattr(value, "number", None) is None
        if own and id(value) not in seen:
            seen.add(id(value))
            paths.append(next(found["image_path_iterator"]))
            value.savefig(paths[-1], dpi=110)
    return text + figure_rst(paths, configuration["src_dir"])


GALLERY = (
    "first_run", "own_rig", "rig_from_a_file", "shapes", "fingertips", "relaxation",
    "finite_strain", "friction_law", "gradient_check", "sensitivities", "batch",
    "torchdiffeq_adjoint", "which_motion", "identify", "identify_friction", "plan_a_motion",
    "train_a_policy", "learn_to_turn", "reduced_model", "energy",
)  # fmt: skip
"""Programs of the gallery, in their order."""


class Order:
    """Sorts the gallery's files."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __call__(self, name: str) -> int:
        return GALLERY.index(Path(name).stem)


sphinx_gallery_conf = {
    "within_subsection_order": Order,
    "examples_dirs": [str(ROOT / "examples" / "gallery")],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "image_scrapers": (figures,),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "remove_config_comments": True,
    "min_reported_time": 10**6,
    "write_computation_times": False,
}

RETARGETED = {
    "](../experiments/README.md": "](experiments.md",
    "](../experiments/validation/README.md": "](validation.md",
    "](validation/README.md": "](validation.md",
    "](../data_gen/README.md": "](datasets.md",
    "](../examples/identify/README.md": "](files.md",
    "](../examples/gallery/README.txt": "](gallery/index",
    "](../../examples/gallery/README.txt": "](gallery/index",
    "](../docs/": "](",
    "](../../docs/": "](",
    "](docs/": "](",
}
"""Links of the repository, and what they are among the pages."""


def retarget(app: Sphinx, *where: Any) -> None:
    """Links as they are in the repository become links between pages."""
    content = where[-1]
    for there, here in RETARGETED.items():
        content[0] = content[0].replace(there, here)
    program = r"\]\(((?:\.\./)*)\.\./examples/gallery/(\w+)\.py"
    content[0] = re.sub(program, r"](\1gallery/\2", content[0])


def mathml(writer: Any, node: nodes.Node) -> None:
    """Formulas in MathML, which browsers draw by themselves."""
    block = isinstance(node, nodes.math_block)
    formula = latex2mathml.tex2mathml(node.astext(), as_block=block)
    formula = re.sub(r"<mo[^>]*>\|</mo>", '<mo lspace="0" rspace="0">|</mo>', formula)
    if block:
        number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
        formula = f'<div class="math-block">{number}{formula}</div>'
    writer.body.append(formula)
    raise nodes.SkipNode


def plain(app: Sphinx, kind: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text, whose only markup is code between backticks."""
    parts = re.split(r"`([^`]+)`", "\n".join(lines))
    parts[::2] = [re.sub(r"[\\*|]|(?<=\w)_(?!\w)", r"\\\g<0>", part) for part in parts[::2]]
    parts[1::2] = [f"``{code}``\\ " for code in parts[1::2]]
    lines[:] = "".join(parts).split("\n")


def generate(app: Sphinx) -> None:
    """Write the reference from the declarations in the code."""
    import reference

    reference.write(ROOT / "docs" / "reference")


def unset(app: Sphinx) -> None:
    """After the gallery, which sets it: kernels of chapters show figures by their own backend."""
    os.environ.pop("MPLBACKEND", None)


def setup(app: Sphinx) -> None:
    app.connect("builder-inited", generate)
    app.connect("builder-inited", unset, priority=900)
    app.connect("autodoc-process-docstring", plain)
    app.add_html_math_renderer("mathml", (mathml, None), (mathml, None))
    app.connect("source-read", retarget)
    app.connect("include-read", retarget)


html_math_renderer = "mathml"
