"""HTML pages from the templates that lie beside the code."""

from jinja2 import Environment, PackageLoader, StrictUndefined


def render_page(package: str, **content) -> str:
    """A package's ``page.html.j2`` as HTML; every name the template uses must be given."""
    environment = Environment(loader=PackageLoader(package, "."), undefined=StrictUndefined, autoescape=True)
    return environment.get_template("page.html.j2").render(**content)
