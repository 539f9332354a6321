"""HTML pages and files for browsers. The pages themselves speak REST only.

Nothing here imports the packages whose files it serves: `find_spec` tells where they lie.
"""

from __future__ import annotations

import hashlib
import re
from http import HTTPStatus
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import FileResponse, RedirectResponse, Response
from fastapi.staticfiles import StaticFiles
from fastapi.templating import Jinja2Templates
from sqlalchemy import select
from sqlalchemy.orm import InstrumentedAttribute
from starlette.exceptions import HTTPException

from server.api import errors
from server.api.access import COOKIE, Anyone, UseServices, who
from server.api.files import FOR_EVER
from server.api.services import services_of
from server.errors import ArtifactError, NotFoundError, NotSignedInError
from server.replay_client import check_parameters, replay_client
from server.schemas.common import MAX_ID
from server.sign_in import Me
from server.states import Role
from server.store.tables import Campaign, Pair

PAGE_POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:;"
    " object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
_NUMBER = re.compile("[0-9]{1,10}", flags=re.ASCII)  # as many digits as MAX_ID has
_SHA256 = re.compile("[0-9a-f]{64}", flags=re.ASCII)

router = APIRouter(include_in_schema=False)


def package_folder(package: str) -> Path:
    """Folder of an installed package, without importing it; raises NotFoundError."""
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        raise NotFoundError("installed package", package)
    return Path(spec.origin).parent


def _site() -> Path:
    return package_folder("labeling_ui") / "site"


def install(app: FastAPI) -> None:
    """Add the pages, their static files and the files behind the session to the application."""
    site = _site()
    app.state.templates = Jinja2Templates(directory=site / "templates")
    app.state.ui_version = f"{app.version}+{_fingerprint(site)}"
    app.include_router(router)
    app.add_exception_handler(HTTPException, _http_error)
    app.mount("/static", _SiteFiles(directory=site / "static", check_dir=False), name="static")


class _SiteFiles(StaticFiles):
    """Files whose names stay the same from version to version: browsers ask each time."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response


def _fingerprint(site: Path) -> str:
    """First 12 digits of the SHA-256 over all files of the site; stored with every label."""
    digest = hashlib.sha256()
    for path in sorted(path for path in site.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(site)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _visitor(request: Request) -> Me | None:
    try:
        return who(services_of(request), token=None, cookie=request.cookies.get(COOKIE))
    except NotSignedInError:
        return None


def _home(me: Me) -> str:
    return "/admin" if me.role == Role.ADMIN else "/label"


def _to_sign_in(request: Request) -> RedirectResponse:
    asked = request.url.path + (f"?{request.url.query}" if request.url.query else "")
    return RedirectResponse(f"/sign-in?next={quote(asked, safe='/')}", status_code=303)


def _asked_for(request: Request) -> str | None:
    """Where `next` leads on this site; browsers take `//host` and `/\\host` for another one."""
    asked = request.query_params.get("next", "")
    return asked if asked.startswith("/") and asked[1:2] not in ("/", "\\") else None


def _render(request: Request, template: str, **context: Any) -> Response:
    templates = request.app.state.templates
    assert isinstance(templates, Jinja2Templates)
    context["ui_version"] = request.app.state.ui_version
    headers = {"Content-Security-Policy": PAGE_POLICY, "Cache-Control": "no-store"}
    return templates.TemplateResponse(request, template, context, headers=headers)


def _page(
    request: Request, template: str, *, admin: bool = False, campaign_id: str | None = None
) -> Response:
    """A page for the signed-in; others go to the sign-in page or, if not admins, to `/label`."""
    me = _visitor(request)
    if me is None:
        return _to_sign_in(request)
    if admin and me.role != Role.ADMIN:
        return RedirectResponse("/label", status_code=303)
    if campaign_id is None:
        return _render(request, template, me=me)
    campaign = None
    if _NUMBER.fullmatch(campaign_id) and int(campaign_id) <= MAX_ID:
        with services_of(request).database.read() as session:
            campaign = session.get(Campaign, int(campaign_id))
    if campaign is None:
        return _not_found(request, me, f"There is no campaign {campaign_id}.")
    return _render(request, template, me=me, campaign=campaign)


def _not_found(request: Request, me: Me | None, what: str) -> Response:
    response = _render(request, "not_found.html", me=me, what=what)
    response.status_code = HTTPStatus.NOT_FOUND
    return response


def _http_error(request: Request, error: Exception) -> Response:
    """A page for a person who asks for an address that is none; scripts get the usual JSON."""
    assert isinstance(error, HTTPException)
    wants_page = request.method == "GET" and "text/html" in request.headers.get("accept", "")
    if error.status_code != HTTPStatus.NOT_FOUND or request.url.path.startswith("/api/"):
        wants_page = False
    if not wants_page:
        return errors.http_error(request, error)
    return _not_found(request, _visitor(request), "There is no page at this address.")


@router.get("/")
def root(request: Request) -> Response:
    """To where this account works."""
    me = _visitor(request)
    return _to_sign_in(request) if me is None else RedirectResponse(_home(me), status_code=303)


@router.get("/sign-in")
def sign_in_page(request: Request) -> Response:
    """Name and password."""
    me = _visitor(request)
    if me is not None:
        return RedirectResponse(_asked_for(request) or _home(me), status_code=303)
    return _render(request, "sign_in.html", me=None)


@router.get("/label")
def label_index(request: Request) -> Response:
    """The campaigns that can be labelled."""
    return _page(request, "label_home.html")


@router.get("/label/{campaign_id}")
def label_page(request: Request, campaign_id: str) -> Response:
    """The annotator's page."""
    return _page(request, "label.html", campaign_id=campaign_id)


@router.get("/admin")
def admin_index(request: Request) -> Response:
    """All campaigns, accounts, tokens."""
    return _page(request, "admin_index.html", admin=True)


@router.get("/admin/campaigns/{campaign_id}")
def admin_campaign(request: Request, campaign_id: str) -> Response:
    """One campaign with its rounds."""
    return _page(request, "admin_campaign.html", admin=True, campaign_id=campaign_id)


def _artifact(
    services: UseServices, sha256: str, column: InstrumentedAttribute[str | None], media_type: str
) -> FileResponse:
    """A file that some pair shows; episodes and checkpoints, which carry the outcome, are none."""
    if _SHA256.fullmatch(sha256) is None:
        raise NotFoundError("file of a pair", sha256)
    with services.database.read() as session:
        if session.scalar(select(Pair.id).where(column == sha256).limit(1)) is None:
            raise NotFoundError("file of a pair", sha256)
    path = services.artifacts.path(sha256)
    if not path.is_file():
        raise ArtifactError(f"artifact {sha256} is missing")
    headers = {"Cache-Control": FOR_EVER, "Content-Security-Policy": "default-src 'none'; sandbox"}
    return FileResponse(path, media_type=media_type, headers=headers)


@router.api_route("/replays/{sha256}.viser", methods=["GET", "HEAD"])
def replay(sha256: str, _me: Anyone, services: UseServices) -> FileResponse:
    """A recording for the replay client."""
    return _artifact(services, sha256, Pair.replay_sha256, "application/octet-stream")


@router.api_route("/thumbnails/{sha256}.webp", methods=["GET", "HEAD"])
def thumbnail(sha256: str, _me: Anyone, services: UseServices) -> FileResponse:
    """An animated picture of a pair."""
    return _artifact(services, sha256, Pair.thumbnail_sha256, "image/webp")


@router.get("/replay-client/")
def show_replay(request: Request) -> Response:
    """The viewer out of the installed viser package, with our adapter in its head."""
    if _visitor(request) is None:
        raise NotSignedInError("sign in first")
    check_parameters(request.query_params)
    adapter = (_site() / "static" / "replay-adapter.js").read_bytes()
    client = replay_client(package_folder("viser") / "client" / "build" / "index.html", adapter)
    tag = f'"{hashlib.sha256(client.page).hexdigest()[:32]}"'
    headers = {
        "Content-Security-Policy": client.policy,
        "Cache-Control": "private, no-cache",
        "ETag": tag,
    }
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    return Response(client.page, media_type="text/html", headers=headers)


@router.get("/vendor/plotly.min.js")
def plotly() -> FileResponse:
    """The chart library out of the installed plotly package."""
    path = package_folder("plotly") / "package_data" / "plotly.min.js"
    headers = {"Cache-Control": "public, max-age=86400"}
    return FileResponse(path, media_type="text/javascript", headers=headers)
