"""Settings of the running system, from `RODIF_*` environment variables (or `.env`)."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """Where things are and how patient they are. Empty URLs mean: inside `state_dir`."""

    model_config = SettingsConfigDict(env_prefix="RODIF_", env_file=".env", extra="ignore")

    state_dir: Path = Path(
        ".rodif"
    )  # database, broker socket, artifacts, logs of the embedded set-up
    database_url: str = ""  # default sqlite:///<state_dir>/rodif.sqlite3
    database_connections: int = Field(default=40, ge=1)  # at most, of each process of the API
    broker_url: str = ""  # default redis+socket://<state_dir>/valkey.sock
    artifact_dir: Path | None = None  # default <state_dir>/artifacts
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535)
    secure_cookies: bool = False  # set when served over HTTPS
    session_hours: float = Field(default=12.0, gt=0)
    lease_seconds: float = Field(default=600.0, gt=0)  # a pair handed to an annotator
    job_lease_seconds: float = Field(default=60.0, gt=0)  # renewed by the worker's heart-beat
    resend_seconds: float = Field(default=10.0, gt=0)  # beat: re-send queued or expired jobs
    round_tick_seconds: float = Field(default=30.0, gt=0)  # beat: start rounds that are due
    argon2_cheap: bool = False  # tests only: fast password hashing

    @model_validator(mode="after")
    def _fill_defaults(self) -> Settings:
        self.state_dir = self.state_dir.expanduser().absolute()
        if not self.database_url:
            self.database_url = f"sqlite:///{self.state_dir / 'rodif.sqlite3'}"
        if not self.broker_url:
            self.broker_url = f"redis+socket://{self.state_dir / 'valkey.sock'}"
        if self.artifact_dir is None:
            self.artifact_dir = self.state_dir / "artifacts"
        return self
