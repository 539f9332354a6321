"""A small client of the REST API: what the commands need, nothing more.

with Client("http://127.0.0.1:8000", token="rdf_…") as api:
    campaign = api.find_campaign("avoid-left")
    job = api.post(f"/campaigns/{campaign['id']}/collect", {"episodes": 60})
    api.wait_for_job(job["id"])
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Self

import httpx2

from rodif_core.errors import RodifError, UnknownNameError

PATIENCE_SECONDS = 30.0  # one request
POLL_SECONDS = 0.5
RETRIES = 4  # of a request that can be repeated without doing anything twice
JOB_ENDS = ("done", "failed", "cancelled")
ROUND_ENDS = ("published", "rejected", "kept", "failed", "cancelled")

Json = dict[str, Any]


class ApiError(RodifError):
    """The API refused a request or cannot be reached; the message is what it answered."""

    def __init__(self, message: str, status: int | None = None) -> None:
        self.status = status  # HTTP status; None when there was no answer
        super().__init__(message)


class WaitError(RodifError):
    """Queued work failed or did not end in time."""


class Client:
    """One account's view of the API; use it from one thread."""

    def __init__(self, url: str, token: str | None = None) -> None:
        self.url = url.rstrip("/")
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx2.Client(
            base_url=f"{self.url}/api/v1", headers=headers, timeout=PATIENCE_SECONDS
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def request(
        self,
        method: str,
        path: str,
        body: Json | None = None,
        *,
        headers: Mapping[str, str] | None = None,
    ) -> httpx2.Response:
        """Send; raises ApiError with the API's own words unless the answer is a success.

        Requests that are safe to repeat (GET, PUT, or with an Idempotency-Key) are repeated when
        the connection breaks or the server is busy.
        """
        repeatable = method in ("GET", "PUT") or "Idempotency-Key" in (headers or {})
        for attempt in range(RETRIES if repeatable else 1):
            if attempt:
                time.sleep(0.2 * 2**attempt)
            try:
                response = self._http.request(method, path, json=body, headers=headers)
            except httpx2.TransportError as error:
                failure = ApiError(f"no answer from {self.url}: {error or type(error).__name__}")
                continue
            if response.is_success:
                return response
            failure = ApiError(_problem(response, f"{method} {path}"), response.status_code)
            if response.status_code not in (429, 502, 503, 504):
                break
        raise failure

    def get(self, path: str) -> Any:
        """Answer of a GET as JSON."""
        return self.request("GET", path).json()

    def post(self, path: str, body: Json) -> Any:
        """Answer of a POST as JSON."""
        return self.request("POST", path, body).json()

    def pages(self, path: str) -> Iterator[Json]:
        """All rows of a listing, page by page."""
        cursor: object = None
        joint = "&" if "?" in path else "?"
        while True:
            page = self.get(path + ("" if cursor is None else f"{joint}cursor={cursor}"))
            yield from page["items"]
            cursor = page.get("next_cursor")
            if cursor is None:
                return

    def sign_in(self, name: str, password: str) -> None:
        """Keep a browser session on this client; `Origin` is what the API's CSRF check wants."""
        self._http.headers["Origin"] = self.url
        self.post("/session", {"name": name, "password": password})

    def find_campaign(self, name_or_id: str | None) -> Json:
        """The campaign by name or number; None means the only one there is."""
        campaigns: list[Json] = self.get("/campaigns")
        if name_or_id is None and len(campaigns) == 1:
            return campaigns[0]
        for campaign in campaigns:
            if name_or_id is not None and name_or_id in (campaign["name"], str(campaign["id"])):
                return campaign
        raise UnknownNameError(
            "campaign", name_or_id or "(none named)", [campaign["name"] for campaign in campaigns]
        )

    def wait_for_job(
        self, job_id: int, *, seconds: float, progress: Callable[[Json], None] | None = None
    ) -> Json:
        """Poll until the job is done; raises WaitError when it fails or takes too long."""
        job = self._wait(f"/jobs/{job_id}", JOB_ENDS, seconds, progress)
        if job["state"] != "done":
            raise WaitError(f"{job['kind']} job {job_id} {job['state']}: {job['error']}")
        return job

    def wait_for_round(
        self, round_id: int, *, seconds: float, progress: Callable[[Json], None] | None = None
    ) -> Json:
        """Poll until the round has ended; raises WaitError when it fails or takes too long."""
        ended = self._wait(f"/rounds/{round_id}", ROUND_ENDS, seconds, progress)
        if ended["state"] in ("failed", "cancelled"):
            raise WaitError(f"round {round_id} {ended['state']}: {ended['error']}")
        return ended

    def _wait(
        self,
        path: str,
        ends: tuple[str, ...],
        seconds: float,
        progress: Callable[[Json], None] | None,
    ) -> Json:
        deadline = time.monotonic() + seconds
        while True:
            row: Json = self.get(path)
            if progress is not None:
                progress(row)
            if row["state"] in ends:
                return row
            if time.monotonic() > deadline:
                raise WaitError(f"{path} is still {row['state']} after {seconds:.0f} seconds")
            time.sleep(POLL_SECONDS)


def _problem(response: httpx2.Response, what: str) -> str:
    """The sentence of a problem+json answer; it names the fields that `errors` lists."""
    try:
        problem = response.json()
    except ValueError:
        problem = {}
    sentence = problem.get("detail") or problem.get("title") or response.reason_phrase
    return f"{what} → {response.status_code}: {sentence}"
