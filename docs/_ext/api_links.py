"""Link code such as `lj.fit`, `lj.bodies.Body` or `Trajectory` in a text to the page of that name."""

from api_pages import name_in, page_of
from docutils import nodes


def link(app, doctree, docname):
    """Link each such piece of code, unless it is part of a link or a title, or stands on its own page."""
    for literal in list(doctree.findall(nodes.literal)):
        name = name_in(literal.astext())
        if name is None:
            continue
        parents, node = [], literal.parent
        while node is not None:
            parents.append(node)
            node = node.parent
        target = f"api/{page_of(name)}"
        if target == docname or any(isinstance(node, (nodes.reference, nodes.title)) for node in parents):
            continue
        uri = app.builder.get_relative_uri(docname, target)
        literal.replace_self(nodes.reference("", "", literal.deepcopy(), refuri=uri, internal=True))


def setup(app):
    """Run after all pages are known."""
    app.connect("doctree-resolved", link)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
