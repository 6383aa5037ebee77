"""Registry of versioned models: uploads, checks, publication, activation, rollback and deletion.

Changes of versions run inside a write transaction.
"""

from __future__ import annotations

import re
import secrets
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from services.errors import Conflict, NotFound, Rejected, StillActive, StoreUnavailable
from services.registry.bundle_file import SUFFIX
from services.registry.checking import PROGRAM, RunningChecks, Verdict, run_check, run_conversion
from services.registry.database import Database
from services.registry.folder import (
    FolderLock,
    StagedUpload,
    UnpackedModels,
    findings,
    folder_name,
    open_blobs,
    remove_leftovers,
    stage,
)
from services.registry.records import (
    ACTIVATABLE,
    ACTIVATIONS,
    MODELS,
    MOST_UPLOAD_BYTES,
    UNCHECKED,
    VERSIONS,
    Change,
    ModelRecord,
    Recovery,
    State,
    VersionRecord,
    activation_steps,
    change_state,
    model_record,
    model_row,
    now,
    set_active,
    version_record,
    version_row,
    version_rows,
)

MODEL_NAME = re.compile(r"[a-z0-9](?:[a-z0-9._-]{0,62}[a-z0-9])?")
MOST_BY = 200


def check_name(name: str) -> None:
    """Check a model name.

    Raises:
        Rejected: if the name is not valid.
    """
    if not MODEL_NAME.fullmatch(name):
        raise Rejected(
            f"{name[:80]!r} cannot be the name of a model; take up to 64 of a-z, 0-9, dot, dash and underscore, with a letter or digit at both ends"
        )


def check_by(by: str) -> None:
    """Check the caller's name, which is stored with a change.

    Raises:
        Rejected: if the name is empty, too long or not printable.
    """
    if not by or len(by) > MOST_BY or not by.isprintable():
        raise Rejected(f"`by` must be 1 to {MOST_BY} printable characters that say who asks, got {by[:80]!r}")


def add_version(connection: sa.Connection, name: str, upload: StagedUpload, blob: str, by: str) -> VersionRecord:
    """Insert the row of a stored upload with the next version number, and the model's row for its first version."""
    at = now().isoformat()
    number = _last_version(connection, name, at) + 1
    connection.execute(sa.update(MODELS).where(MODELS.c.name == name).values(last_version=number))
    connection.execute(
        sa.insert(VERSIONS).values(
            name=name,
            version=number,
            state=str(State.UPLOADED),
            digest=upload.digest,
            size_bytes=upload.size_bytes,
            manifest_sha256=upload.manifest_sha256,
            tensors_sha256=upload.tensors_sha256,
            blob=blob,
            uploaded_by=by,
            uploaded_at=at,
            changed_by=by,
            changed_at=at,
            description={},
        )
    )
    return version_record(version_row(connection, name, number))


def _last_version(connection: sa.Connection, name: str, at: str) -> int:
    """Return the highest version number of the model, creating the model if it does not exist."""
    try:
        return int(model_row(connection, name)["last_version"])
    except NotFound:
        connection.execute(sa.insert(MODELS).values(name=name, created_at=at, last_version=0))
        return 0


Reached = Callable[[str], None]
"""Callback that receives the name of each completed stage of a change, such as `upload committed`."""


def check_activatable(record: VersionRecord) -> None:
    """Check that a version can be activated.

    Raises:
        Conflict: if its state does not permit activation.
    """
    if record.state not in ACTIVATABLE:
        why = f" ({record.reason})" if record.state is State.REJECTED else ""
        raise Conflict(
            f"version {record.version} of model {record.name!r} is {record.state}{why}; only one that is"
            f" {' or '.join(ACTIVATABLE)} can be activated"
        )


def activate(
    connection: sa.Connection, name: str, version: int, expected: int | None, by: str, reached: Reached
) -> Change:
    """Activate a version in place of `expected`.

    Raises:
        NotFound: if the model or the version does not exist.
        Conflict: if another version than `expected` is active, or the version is not activatable.
    """
    before = _active_as_expected(connection, name, expected)
    check_activatable(version_record(version_row(connection, name, version)))
    at = now()
    if before is not None:
        change_state(connection, name, before, State.RETIRED, by, at)
        reached("earlier version retired")
    change_state(connection, name, version, State.ACTIVE, by, at, reason=None)
    reached("version marked active")
    steps = activation_steps(connection, name)
    step = steps[-1][0] + 1 if steps else 1
    connection.execute(sa.insert(ACTIVATIONS).values(name=name, step=step, version=version))
    set_active(connection, name, version)
    reached("model points to version")
    return _change(connection, "activate", name, version, by=by, at=at, active_before=before, active_after=version)


def rollback(
    connection: sa.Connection, name: str, expected: int | None, by: str, reason: str | None, reached: Reached
) -> Change:
    """Activate the previously active version again.

    Args:
        expected: version that must be active; None accepts any.

    Raises:
        NotFound: if the model does not exist.
        Conflict: if there is no earlier version, or another version than `expected` is active.
    """
    before = model_row(connection, name)["active"]
    if expected is not None:
        _active_as_expected(connection, name, expected)
    steps = activation_steps(connection, name)
    kept = list(steps)
    while kept and kept[-1][1] == before:
        kept.pop()
    if before is None or not kept:
        raise Conflict(f"model {name!r} has no version that was active before {before or 'any'}; activate one instead")
    at, target = now(), kept[-1][1]
    change_state(connection, name, before, State.RETIRED, by, at, reason=reason)
    reached("active version retired")
    change_state(connection, name, target, State.ACTIVE, by, at, reason=None)
    connection.execute(sa.delete(ACTIVATIONS).where(ACTIVATIONS.c.name == name, ACTIVATIONS.c.step > kept[-1][0]))
    reached("activations taken back")
    set_active(connection, name, target)
    facts = {"by": by, "at": at, "active_before": before, "active_after": target, "why": reason}
    return _change(connection, "rollback", name, target, **facts)


def delete(connection: sa.Connection, name: str, version: int, by: str) -> Change:
    """Delete a version's row and its activations.

    Raises:
        NotFound: if the version does not exist.
        StillActive: if the version is active.
    """
    active = model_row(connection, name)["active"]
    facts = {"by": by, "at": now(), "active_before": active, "active_after": active}
    change = _change(connection, "delete", name, version, **facts)
    if version == active:
        raise StillActive(f"version {version} of model {name!r} is active; activate another one before it is deleted")
    of_version = ACTIVATIONS.c.name == name, ACTIVATIONS.c.version == version
    connection.execute(sa.delete(ACTIVATIONS).where(*of_version))
    connection.execute(sa.delete(VERSIONS).where(VERSIONS.c.name == name, VERSIONS.c.version == version))
    return change


def _change(connection: sa.Connection, action: str, name: str, version: int, **facts: Any) -> Change:
    """Return the change record with the version's current row.

    Raises:
        NotFound: if the version does not exist.
    """
    return Change(**vars(version_record(version_row(connection, name, version))), action=action, **facts)


def _active_as_expected(connection: sa.Connection, name: str, expected: int | None) -> int | None:
    active: int | None = model_row(connection, name)["active"]
    if active != expected:
        raise Conflict(
            f"model {name!r} has {_version_in_words(active)} active, not {_version_in_words(expected)} as expected; look again and decide anew"
        )
    return active


def _version_in_words(version: int | None) -> str:
    return "no version" if version is None else f"version {version}"


DATABASE_FILE = "registry.sqlite"
CHECKER = "registry"
"""Value of `changed_by` for a version whose state was set by the check, not by a caller."""
RECOVERY_WAIT_S = 5.0


def _nothing(_: str) -> None:
    pass


class ModelRegistry:
    """Versioned models. Synchronous and thread-safe; several processes may open the same registry.

    Versions are immutable. Each change is one durable transaction: after a crash either the old or the new state holds.
    Every method raises StoreUnavailable if the database or the files are unavailable.
    """

    def __init__(
        self,
        folder: Path,
        *,
        database_url: str | None = None,
        blobs_url: str | None = None,
        blob_options: dict[str, Any] | None = None,
        most_upload_bytes: int = MOST_UPLOAD_BYTES,
        device: str = "cpu",
        reached: Callable[[str], None] = _nothing,
        check_program: tuple[str, ...] = PROGRAM,
        convert_program: tuple[str, ...] = PROGRAM,
    ) -> None:
        """Open the registry in `folder`, create it if missing, and migrate its database.

        Args:
            folder: folder of the registry.
            database_url: `postgresql://…`, or None for SQLite in the folder.
            blobs_url: `s3://BUCKET/PREFIX`, or None to store uploads in the folder.
            blob_options: further options of the fsspec file system, such as an endpoint URL.
            most_upload_bytes: largest upload in bytes.
            device: device on which checks render, cpu or cuda.
            reached: called with the name of each completed step, in the calling thread.
            check_program: command that checks a folder.
            convert_program: command that converts a splat file.

        Raises:
            SchemaTooNew: if a later version of the program wrote the database.
        """
        self._folder, self._most_upload_bytes, self._device = folder, most_upload_bytes, device
        self._reached, self._check_program, self._convert_program = reached, check_program, convert_program
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
        self._checks, self._converting = threading.Lock(), threading.Lock()
        self._running = RunningChecks()
        self._lock = FolderLock(folder / "lock")
        self._database = Database(database_url or f"sqlite:///{folder.absolute() / DATABASE_FILE}")
        self._database.migrate()

    def upload(self, name: str, file: Path, digest: str | None, by: str) -> VersionRecord:
        """Store a copy of an `.isplat` file as a new version in the state `uploaded`.

        Args:
            name: the model.
            file: path of the upload; the file stays in place.
            digest: SHA-256 stated by the sender, in hex, or None.
            by: the caller, for the record.

        Raises:
            Rejected: if name, size, digest or format is invalid.
        """
        check_name(name)
        check_by(by)
        with self._lock.shared():
            staged = stage(file, self._incoming, digest, self._most_upload_bytes)
            self._reached("upload staged")
            blob = f"{staged.digest}-{secrets.token_hex(8)}{SUFFIX}"
            try:
                self._blobs.publish(staged.path, blob)
                self._reached("blob stored")
                return self._add(name, staged, blob, by)
            finally:
                staged.path.unlink(missing_ok=True)

    def upload_splats(self, name: str, file: Path, format_name: str, by: str) -> VersionRecord:
        """Convert a splat file of another program in a separate process, and store it as a new version.

        The version's digest and size are those of the `.isplat` file that the conversion made. One conversion runs at a
        time; further ones wait.

        Args:
            name: the model.
            file: path of the upload; the file stays in place.
            format_name: `ply`, `splat` or `spz`.
            by: the caller, for the record.

        Raises:
            Rejected: if the name or the file is invalid.
            CheckFailed: if the conversion could not run.
        """
        check_name(name)
        check_by(by)
        with self._converting, tempfile.TemporaryDirectory(prefix="splats-", dir=self._incoming) as folder:
            named = Path(folder) / f"file.{format_name}"
            named.symlink_to(file.absolute())
            packed = Path(folder) / f"model{SUFFIX}"
            reason = run_conversion(named, packed, self._convert_program, self._running)
            if reason is not None:
                raise Rejected(reason.replace(named.name, f"the .{format_name} file"))
            return self.upload(name, packed, None, by)

    def check(self, name: str, version: int) -> VersionRecord:
        """Check an uploaded version in a separate process; blocks until it is `ready` or `rejected` with a reason.

        One check runs at a time; further checks wait. A version that was already checked is returned unchanged.

        Raises:
            NotFound: if the version does not exist.
            BlobDamaged: if its file is missing or altered.
            CheckFailed: if the check could not run; the version stays unchecked.
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
            verdict = run_check(folder, self._device, validated, self._check_program, self._running)
        self._reached("check ended")
        state = State.READY if verdict.reason is None else State.REJECTED
        return self._after_check(name, version, state, verdict)

    def activate(self, name: str, version: int, expected_current: int | None, by: str) -> Change:
        """Activate a version in place of `expected_current`; the previous one becomes `retired`.

        Args:
            name: the model.
            version: version to activate.
            expected_current: version that must be active; None if none may be.
            by: the caller, for the record.

        Raises:
            NotFound: if the version does not exist.
            Conflict: if another version than `expected_current` is active, or `version` is neither ready nor retired.
            BlobDamaged: if its file is missing or altered.
        """
        check_by(by)
        with self._database.reading() as connection:
            row = version_row(connection, name, version)
        check_activatable(version_record(row))
        self.folder_of(name, version)
        self._reached("files of the version checked")
        with self._database.writing() as connection:
            change = activate(connection, name, version, expected_current, by, self._reached)
        self._reached("activation committed")
        return change

    def rollback(self, name: str, by: str, *, expected_current: int | None = None, reason: str | None = None) -> Change:
        """Activate the previously active version. Repeated calls go further back.

        Args:
            name: the model.
            by: the caller, for the record.
            expected_current: version that must be active, which protects newer changes; None accepts any.
            reason: reason stored with the rolled back version.

        Raises:
            NotFound: if the model does not exist.
            Conflict: if there is no earlier version, or another version is active.
            BlobDamaged: if the file of the target version is missing or altered.
        """
        check_by(by)
        with self._lock.shared(), self._database.writing() as connection:
            change = rollback(connection, name, expected_current, by, reason, self._reached)
            self._unpacked.folder_of(version_row(connection, name, change.version))
        self._reached("rollback committed")
        return change

    def delete(self, name: str, version: int, by: str) -> Change:
        """Delete a version and its file. Its number is not reused.

        Raises:
            NotFound: if the version does not exist.
            StillActive: if the version is active.
        """
        check_by(by)
        with self._database.reading() as connection:
            row = version_row(connection, name, version)
        with self._lock.shared():
            with self._database.writing() as connection:
                change = delete(connection, name, version, by)
                if folder_name(row) not in {folder_name(each) for each in version_rows(connection)}:
                    self._unpacked.remove(row)
                self._reached("unpacked copy deleted")
            self._reached("row deleted")
            self._blobs.remove(row["blob"])
            self._reached("blob deleted")
        return change

    def models(self) -> list[ModelRecord]:
        """Return every model, ordered by name."""
        with self._database.reading() as connection:
            rows = connection.execute(sa.select(MODELS).order_by(MODELS.c.name)).mappings()
            return [model_record(row) for row in rows]

    def versions(self, name: str) -> list[VersionRecord]:
        """Return the versions of a model, oldest first.

        Raises:
            NotFound: if the model does not exist.
        """
        with self._database.reading() as connection:
            model_row(connection, name)
            return [version_record(row) for row in version_rows(connection, name)]

    def version(self, name: str, number: int) -> VersionRecord:
        """Return one version.

        Raises:
            NotFound: if the version does not exist.
        """
        with self._database.reading() as connection:
            return version_record(version_row(connection, name, number))

    def active(self, name: str) -> VersionRecord | None:
        """Return the active version, or None.

        Raises:
            NotFound: if the model does not exist.
            Conflict: if versions are activated and deleted all the time.
        """
        for _ in range(3):
            with self._database.reading() as connection:
                number = model_row(connection, name)["active"]
                if number is None:
                    return None
                try:
                    return version_record(version_row(connection, name, number))
                except NotFound:
                    continue  # between the two queries, the version was replaced and deleted: query again
        raise Conflict(f"the active version of model {name!r} changes all the time; ask again")

    def folder_of(self, name: str, version: int) -> Path:
        """Return the folder with a version's `manifest.json` and `model.safetensors`, for
        `load_bundle`. The digests are verified, and the folder stays until the version is deleted.

        Raises:
            NotFound: if the version does not exist.
            BlobDamaged: if its file is missing or altered.
        """
        with self._database.reading() as connection:
            row = version_row(connection, name, version)
        with self._lock.shared():
            return self._unpacked.folder_of(row)

    def recover(self, wait_s: float = RECOVERY_WAIT_S) -> Recovery:
        """Delete leftovers of dead processes and report damage. Called at start; nothing is repaired.

        Args:
            wait_s: seconds to wait for other writers. After that nothing is deleted, and `skipped` is set.
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
        """Kill running checks, whose versions stay unchecked, and close the database."""
        self._running.end()
        self._database.close()

    def __enter__(self) -> ModelRegistry:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add(self, name: str, staged: StagedUpload, blob: str, by: str) -> VersionRecord:
        with self._database.writing() as connection:
            record = add_version(connection, name, staged, blob, by)
            self._reached("row written")
        # After StoreUnavailable the row may or may not exist: `recover` removes the file if there is no row.
        self._reached("upload committed")
        return record

    def _after_check(self, name: str, version: int, state: State, verdict: Verdict) -> VersionRecord:
        """Store the verdict of a check, unless a concurrent check of the version has stored its verdict first."""
        with self._database.writing() as connection:
            if State(version_row(connection, name, version)["state"]) in UNCHECKED:
                found = {"reason": verdict.reason, "description": verdict.description}
                change_state(connection, name, version, state, CHECKER, now(), **found)
            return version_record(version_row(connection, name, version))
