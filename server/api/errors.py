"""From exceptions to `application/problem+json` (RFC 9457). One table decides the status."""

from __future__ import annotations

import logging
import reprlib
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from rodif_core.errors import RodifError, UnknownNameError, ValueOutOfRangeError
from server.errors import (
    ArtifactError,
    ConflictError,
    DatabaseVersionError,
    LeaseLostError,
    NotAllowedError,
    NotFoundError,
    NotSignedInError,
    ThrottledError,
)

logger = logging.getLogger(__name__)

STATUS_OF: dict[type[RodifError], HTTPStatus] = {
    NotSignedInError: HTTPStatus.UNAUTHORIZED,
    NotAllowedError: HTTPStatus.FORBIDDEN,
    NotFoundError: HTTPStatus.NOT_FOUND,
    ArtifactError: HTTPStatus.NOT_FOUND,
    ConflictError: HTTPStatus.CONFLICT,
    LeaseLostError: HTTPStatus.CONFLICT,
    UnknownNameError: HTTPStatus.UNPROCESSABLE_ENTITY,
    ValueOutOfRangeError: HTTPStatus.UNPROCESSABLE_ENTITY,
    ThrottledError: HTTPStatus.TOO_MANY_REQUESTS,
    DatabaseVersionError: HTTPStatus.SERVICE_UNAVAILABLE,
}
PROBLEM_TYPE = "application/problem+json"
_SECRET = ("password", "token", "cookie", "authorization")  # parts of names of secret fields
_short = reprlib.Repr()
_short.maxstring = _short.maxlong = _short.maxother = 60  # characters of a value in a message


def problem(
    status: int,
    detail: str,
    *,
    errors: list[dict[str, Any]] | None = None,
    headers: dict[str, str] | None = None,
) -> JSONResponse:
    """An error answer; `errors` lists fields of the request that do not fit."""
    body: dict[str, Any] = {
        "type": "about:blank",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
    }
    if errors is not None:
        body["errors"] = errors
    return JSONResponse(body, status_code=status, headers=headers, media_type=PROBLEM_TYPE)


def install(app: FastAPI) -> None:
    """Register the handlers below, and say in the OpenAPI document what errors look like."""
    describe = app.openapi

    def openapi() -> dict[str, Any]:
        document = describe()
        for methods in document["paths"].values():
            for operation in methods.values():
                _name_media_type(operation["responses"])
        return document

    app.openapi = openapi  # type: ignore[method-assign]  # the documented way to extend it
    app.add_exception_handler(RodifError, _rodif_error)
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(HTTPException, http_error)
    app.add_exception_handler(Exception, _unexpected_error)


def _name_media_type(responses: dict[str, Any]) -> None:
    """FastAPI writes every model down as application/json; errors are application/problem+json."""
    for response in responses.values():
        content = response.get("content", {})
        schema = content.get("application/json", {}).get("schema", {})
        if schema.get("$ref", "").endswith("/Problem"):
            content[PROBLEM_TYPE] = content.pop("application/json")


def _rodif_error(_request: Request, error: Exception) -> JSONResponse:
    status = next(
        (STATUS_OF[kind] for kind in type(error).__mro__ if kind in STATUS_OF),
        HTTPStatus.BAD_REQUEST,
    )
    headers = {}
    if isinstance(error, ThrottledError):
        headers["Retry-After"] = str(error.retry_after)
    if isinstance(error, NotSignedInError):
        headers["WWW-Authenticate"] = "Bearer"
    errors = None
    if isinstance(error, UnknownNameError | ValueOutOfRangeError):
        name = error.kind if isinstance(error, UnknownNameError) else error.name
        legal = list(error.legal) if isinstance(error.legal, tuple) else error.legal
        legal = [str(item) for item in legal] if isinstance(legal, list) else legal
        errors = [{"field": name, "message": str(error), "legal": legal}]
    return problem(status, str(error), errors=errors, headers=headers)


def _validation_error(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    found = [
        {"field": ".".join(str(part) for part in item["loc"]), "message": _message(item)}
        for item in error.errors()
    ]
    if any(item["type"] == "json_invalid" for item in error.errors()):
        return problem(HTTPStatus.BAD_REQUEST, "the body is not JSON", errors=found)
    fields = "; ".join(f"{item['field']}: {item['message']}" for item in found)
    return problem(HTTPStatus.UNPROCESSABLE_ENTITY, fields, errors=found)


def _message(item: Mapping[str, Any]) -> str:
    """What is legal, and what was given, unless that is secret or may hold something secret.

    So no whole bodies, objects and lists are shown, and nothing of an unknown field: its name may
    be that of a password, misspelt.
    """
    place, given, message = item["loc"], item.get("input"), str(item["msg"])
    secret = any(word in str(part).lower() for part in place for word in _SECRET)
    unnamed = item["type"] in ("missing", "extra_forbidden", "json_invalid")
    if secret or unnamed or len(place) < 2 or isinstance(given, dict | list):
        return message
    return f"{message} (given: {_short.repr(given)})"


def http_error(_request: Request, error: Exception) -> JSONResponse:
    """What the framework itself refuses, such as an unknown address."""
    assert isinstance(error, HTTPException)
    headers = dict(error.headers) if error.headers else None
    return problem(error.status_code, str(error.detail), headers=headers)


def _unexpected_error(request: Request, error: Exception) -> JSONResponse:
    logger.error("unexpected error in %s %s", request.method, request.url.path, exc_info=error)
    return problem(HTTPStatus.INTERNAL_SERVER_ERROR, "unexpected error; the log has the details")
