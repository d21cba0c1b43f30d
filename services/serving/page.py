"""The page of the service: one file that holds nothing of the service and asks for all with the token."""

from services.cli.colours import COLOURS
from services.reporting.page import templates_of

HEADERS = {
    "content-security-policy": (
        "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; img-src data:; "
        "media-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
}
"""The page runs nothing that comes from elsewhere, and is in no other's frame."""


def page() -> str:
    """Return the page, in the style of a run's."""
    return templates_of("services.serving", "services.reporting").get_template("service.html").render(colours=COLOURS)
