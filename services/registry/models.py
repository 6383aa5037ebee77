"""The registry of versioned models: uploads, checks, and which version is served."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from services.registry import activation
from services.registry.blobs import open_blobs
from services.registry.bundle_file import SUFFIX
from services.registry.checking import PROGRAM, RunningChecks, Verdict, run_check
from services.registry.database import Database
from services.registry.errors import Conflict, NotFound, StoreUnavailable
from services.registry.folder_lock import FolderLock
from services.registry.limits import RegistryLimits
from services.registry.publishing import add_version, check_by, check_name
from services.registry.records import UNCHECKED, Change, ModelRecord, Recovery, State, VersionRecord
from services.registry.recovery import findings, remove_leftovers
from services.registry.rows import (
    change_state,
    model_record,
    model_row,
    now,
    version_record,
    version_row,
    version_rows,
)
from services.registry.staging import StagedUpload, stage
from services.registry.tables import MODELS
from services.registry.unpacked import UnpackedModels, folder_name

DATABASE_FILE = "registry.sqlite"
CHECKER = "registry"
"""Who brings versions into the states that a check leads to."""
RECOVERY_WAIT_S = 5.0


def _nothing(_: str) -> None:
    pass


class ModelRegistry:
    """Versioned models. Synchronous; any thread may call it, and several processes may have the same registry open.

    A version is immutable. A change is a transaction that is on the disk when the call returns, whatever happens to the process: before it
    the old state holds, after it the new one. Every method raises StoreUnavailable where database or files do not answer.
    """

    def __init__(
        self,
        folder: Path,
        *,
        database_url: str | None = None,
        blobs_url: str | None = None,
        blob_options: dict[str, Any] | None = None,
        limits: RegistryLimits = RegistryLimits(),
        device: str = "cpu",
        reached: Callable[[str], None] = _nothing,
        check_program: tuple[str, ...] = PROGRAM,
    ) -> None:
        """Open the registry in `folder`, which is made, and bring its database to this program's schema.

        Args:
            database_url: None: SQLite in the folder; or `postgresql://…`.
            blobs_url: None: uploaded files lie in the folder; or `s3://BUCKET/PREFIX`.
            blob_options: further options of the fsspec file system, such as an endpoint's URL.
            device: where checks render, cpu or cuda.
            reached: told the name of each step of a change, in the thread that makes it.
            check_program: what runs the check of a folder.

        Raises SchemaTooNew where a later version of the program has written the database.
        """
        self._folder, self._limits, self._device = folder, limits, device
        self._reached, self._check_program = reached, check_program
        self._incoming = folder / "incoming"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._incoming.mkdir(mode=0o700, exist_ok=True)
            self._blobs = open_blobs(blobs_url, folder / "blobs", blob_options)
            self._unpacked = UnpackedModels(folder / "unpacked", self._incoming, self._blobs, reached)
        except OSError as error:
            raise StoreUnavailable(
                f"the registry cannot use {folder}: {error.strerror or error}; give a folder that can be written"
            ) from error
        self._checks = threading.BoundedSemaphore(limits.checks_at_once)
        self._running = RunningChecks()
        self._lock = FolderLock(folder / "lock")
        self._database = Database(database_url or f"sqlite:///{folder.absolute() / DATABASE_FILE}")
        self._database.migrate()

    def upload(
        self, name: str, file: Path, digest: str | None, by: str, *, version: int | None = None
    ) -> VersionRecord:
        """Store an `.isplat` file as a new version of a model, in the state `uploaded`. The file is copied and stays where it is.

        Args:
            digest: SHA-256 of the file as its sender states it, in hexadecimal; None: it was not stated.
            by: who uploads.
            version: the number that it must get; None: the next one.

        Raises Rejected (name, size, digest, not the format), Conflict (the number was given before).
        """
        check_name(name)
        check_by(by)
        with self._lock.shared():
            staged = stage(file, self._incoming, digest, self._limits)
            self._reached("upload staged")
            blob = f"{staged.digest}-{secrets.token_hex(8)}{SUFFIX}"
            try:
                self._blobs.publish(staged.path, blob)
                self._reached("blob stored")
                return self._add(name, version, staged, blob, by)
            finally:
                staged.path.unlink(missing_ok=True)

    def check(self, name: str, version: int) -> VersionRecord:
        """Check an uploaded version in a process of its own; blocks until it is `ready`, or `rejected` with a reason.

        Checks wait for each other, `RegistryLimits.checks_at_once` run. A version that was checked before is answered as it is. Raises NotFound, BlobDamaged, and CheckFailed where the check could not be run:
        the version then waits for another one.
        """

        def validated(description: dict[str, Any]) -> None:
            self._after_check(name, version, State.VALIDATED, Verdict(None, description))
            self._reached("version validated")

        with self._checks:
            with self._database.reading() as connection:
                row = version_row(connection, name, version)
            if State(row["state"]) not in UNCHECKED:
                return version_record(row)
            with self._lock.shared():
                folder = self._unpacked.folder_of(row)
            verdict = run_check(folder, self._limits, self._device, validated, self._check_program, self._running)
        self._reached("check ended")
        state = State.READY if verdict.reason is None else State.REJECTED
        return self._after_check(name, version, state, verdict)

    def activate(self, name: str, version: int, expected_current: int | None, by: str) -> Change:
        """Let a version be served in place of `expected_current` (None: no version is active). The one before becomes `retired`.

        Raises NotFound, Conflict (another version is active than expected, or this one is not ready), BlobDamaged (it could not be served).
        """
        check_by(by)
        with self._database.reading() as connection:
            row = version_row(connection, name, version)
        activation.check_activatable(version_record(row))
        self.folder_of(name, version)
        self._reached("files of the version checked")
        with self._database.writing() as connection:
            change = activation.activate(connection, name, version, expected_current, by, self._reached)
        self._reached("activation committed")
        return change

    def rollback(self, name: str, by: str, *, expected_current: int | None = None, reason: str | None = None) -> Change:
        """Serve again what was served before the active version; called again it goes back further.

        Args:
            expected_current: the version that must be active, so that nobody's newer choice is undone; None: whichever is.
            reason: why; it stays with the version that is rolled back.

        Raises NotFound, Conflict (nothing was active before, or another version is active), BlobDamaged.
        """
        check_by(by)
        with self._lock.shared(), self._database.writing() as connection:
            change = activation.rollback(connection, name, expected_current, by, reason, self._reached)
            self._unpacked.folder_of(version_row(connection, name, change.version))
        self._reached("rollback committed")
        return change

    def delete(self, name: str, version: int, by: str) -> Change:
        """Remove a version and its file; its number is not given again. Raises NotFound, StillActive."""
        check_by(by)
        with self._database.reading() as connection:
            row = version_row(connection, name, version)
        with self._lock.shared():
            with self._database.writing() as connection:
                change = activation.delete(connection, name, version, by)
                if folder_name(row) not in {folder_name(each) for each in version_rows(connection)}:
                    self._unpacked.remove(row)
                self._reached("unpacked copy deleted")
            self._reached("row deleted")
            self._blobs.remove(row["blob"])
            self._reached("blob deleted")
        return change

    def models(self) -> list[ModelRecord]:
        """Every model, by name."""
        with self._database.reading() as connection:
            rows = connection.execute(sa.select(MODELS).order_by(MODELS.c.name)).mappings()
            return [model_record(row) for row in rows]

    def versions(self, name: str) -> list[VersionRecord]:
        """The versions of a model, the oldest first. Raises NotFound."""
        with self._database.reading() as connection:
            model_row(connection, name)
            return [version_record(row) for row in version_rows(connection, name)]

    def version(self, name: str, number: int) -> VersionRecord:
        """One version. Raises NotFound."""
        with self._database.reading() as connection:
            return version_record(version_row(connection, name, number))

    def active(self, name: str) -> VersionRecord | None:
        """The version that is served; None where no one has been activated. Raises NotFound."""
        for _ in range(3):
            with self._database.reading() as connection:
                number = model_row(connection, name)["active"]
                if number is None:
                    return None
                try:
                    return version_record(version_row(connection, name, number))
                except NotFound:
                    continue  # replaced and deleted in between
        raise Conflict(f"the active version of model {name!r} changes all the time; ask again")

    def folder_of(self, name: str, version: int) -> Path:
        """The folder with a version's `manifest.json` and `model.safetensors`, for `load_bundle`; both have the digests of the upload.

        It stays until the version is deleted. Raises NotFound, BlobDamaged.
        """
        with self._database.reading() as connection:
            row = version_row(connection, name, version)
        with self._lock.shared():
            return self._unpacked.folder_of(row)

    def recover(self, wait_s: float = RECOVERY_WAIT_S) -> Recovery:
        """Called at start: remove what processes that died left half-written, and say what else is not as it should be. Nothing is repaired.

        wait_s: how long to wait for others that are writing; after that nothing is removed, and `skipped` says so.
        """
        with self._lock.alone(wait_s) as alone:
            stored = self._blobs.stored()
            with self._database.reading() as connection:
                rows = version_rows(connection)
            if not alone:
                return findings(
                    rows, stored, (), "another process is writing into the registry, so that nothing was removed"
                )
            try:
                removed = remove_leftovers(rows, stored, self._blobs, self._incoming, self._unpacked)
            except OSError as error:
                raise StoreUnavailable(
                    f"leftovers in {self._folder} cannot be removed: {error}; check its rights"
                ) from error
        return findings(rows, stored, removed, None)

    def close(self) -> None:
        """End the checks that run, whose versions wait for another one, and close the connections to the database."""
        self._running.end()
        self._database.close()

    def __enter__(self) -> ModelRegistry:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add(self, name: str, version: int | None, staged: StagedUpload, blob: str, by: str) -> VersionRecord:
        try:
            with self._database.writing() as connection:
                record = add_version(connection, name, version, staged, blob, by)
                self._reached("row written")
        except Conflict:
            self._blobs.remove(blob)
            raise
        # After StoreUnavailable nobody knows whether the row is there: `recover` removes the file if it is not.
        self._reached("upload committed")
        return record

    def _after_check(self, name: str, version: int, state: State, verdict: Verdict) -> VersionRecord:
        """Write what a check found, unless another check of the same version was faster."""
        with self._database.writing() as connection:
            if State(version_row(connection, name, version)["state"]) in UNCHECKED:
                found = {"reason": verdict.reason, "description": verdict.description}
                change_state(connection, name, version, state, CHECKER, now(), **found)
            return version_record(version_row(connection, name, version))
