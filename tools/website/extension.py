"""Extension of Sphinx: equations without scripts, links to homes of names, signatures as written."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache, partial
from typing import Any

from docutils import nodes
from jinja2.bccache import Bucket, BytecodeCache
from jinja2.sandbox import SandboxedEnvironment
from numpydoc import docscrape_sphinx
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.inspect import stringify_signature

from website.equations import to_mathml
from website.names import find_home, find_names, find_pages, is_package, list_aliases


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect everything."""
    app.add_html_math_renderer("mathml", (_visit_math, None), (_visit_display, None))
    app.connect("missing-reference", _find_reference)
    app.connect("autodoc-process-signature", _write_signature, priority=100)  # before numpydoc
    docscrape_sphinx.SandboxedEnvironment = partial(SandboxedEnvironment, bytecode_cache=_CompiledTemplates())
    app.connect("html-page-context", _share_sidebar, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _visit_math(visitor: Any, node: nodes.math) -> None:
    visitor.body.append(to_mathml(node.astext()))
    raise nodes.SkipNode


def _visit_display(visitor: Any, node: nodes.math_block) -> None:
    visitor.body.append(f'<div class="equation">{to_mathml(node.astext(), display=True)}</div>')
    raise nodes.SkipNode


def _find_reference(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.Node | None:
    """Link another path of a public name to its home, and a name alone if it is that of one public name."""
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"].lstrip("~.")
    home = find_home(target) or find_home(f"{node.get('py:module', '')}.{target}") or _find_alone(target)
    if home is None:
        return None
    domain = env.get_domain("py")
    if home in find_pages() and home not in domain.objects:  # a module
        return domain.resolve_xref(env, node["refdoc"], app.builder, "mod", home, node, content)
    return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", home, node, content)


def _find_alone(target: str) -> str | None:
    """Return the home of ``Model`` or ``model.Model.fk``, from the last capitalised word on."""
    words = target.split(".")
    for i, word in enumerate(words):
        if home := list_aliases().get(word):
            return ".".join([home, *words[i + 1 :]])
    return None


def _write_signature(
    app: Sphinx,
    what: str,
    name: str,
    documented: Any,
    options: Any,
    signature: str | None,
    returns: str | None,
) -> tuple[str, str | None] | None:
    """Return a signature with the types as the source has them, where names of types are not yet replaced."""
    if signature is None or what not in ("class", "exception", "function", "method"):
        return None
    if what in ("class", "exception"):
        if inspect.isabstract(documented) or getattr(documented, "_is_protocol", False):
            return "", None
        if issubclass(documented, BaseException) and "__init__" not in vars(documented):
            return "", None
    try:
        found = inspect.signature(documented)
    except (TypeError, ValueError):
        return None
    parameters = [one for one in found.parameters.values() if one.name[0] != "_" and one.name != "self"]
    text = stringify_signature(
        found.replace(parameters=parameters, return_annotation=inspect.Signature.empty), short_literals=True
    )
    result = found.return_annotation
    if what in ("class", "exception") or result is inspect.Signature.empty or not isinstance(result, str):
        return text, None
    return text, result


def _share_sidebar(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: nodes.document | None
) -> None:
    """Give the page of a name the tree of its module's page: to list all names in each would take long."""
    home = _homes_by_page().get(page)
    if home and "toctree" in context:
        context["toctree"] = lambda **options: _draw_tree(app.builder, home, tuple(options.items()))


@cache
def _homes_by_page() -> dict[str, str]:
    """Return the page of the module of each page of a name."""
    pages = find_pages()
    return {pages[one.home]: pages[one.module] for one in find_names() if is_package(one.module)}


class _CompiledTemplates(BytecodeCache):
    """Compiled templates of numpydoc, which would else compile them for each docstring."""

    def __init__(self) -> None:
        self._code: dict[str, bytes] = {}

    def load_bytecode(self, bucket: Bucket) -> None:
        """Fill a bucket."""
        if bucket.key in self._code:
            bucket.bytecode_from_string(self._code[bucket.key])

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep a bucket."""
        self._code[bucket.key] = bucket.bytecode_to_string()


@cache
def _draw_tree(builder: Any, page: str, options: tuple[tuple[str, Any], ...]) -> str:
    """Draw the tree of the sidebar as it is on a page."""
    draw: Callable[..., str] = builder._get_local_toctree
    return draw(page, **dict(options))
