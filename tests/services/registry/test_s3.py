"""The blob store on an S3 server."""

import secrets

import pytest

from gsplat_core.io.bundle import load_bundle
from services.errors import BlobDamaged, StoreUnavailable
from services.registry.folder import RemoteBlobs
from services.registry.models import ModelRegistry
from tests.services.registry.made import add_ready, assert_whole, packed_model, sha256
from tests.services.registry.stub_check import ALWAYS_READY

pytestmark = pytest.mark.slow


@pytest.fixture
def credentials(monkeypatch):
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "tester")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")


@pytest.fixture
def bucket(s3, credentials):
    """File system and name of a new bucket."""
    import s3fs

    files = s3fs.S3FileSystem(**s3, skip_instance_cache=True)
    name = f"models-{secrets.token_hex(4)}"
    files.mkdir(name)
    return files, name


@pytest.fixture
def registry(bucket, s3, tmp_path):
    with ModelRegistry(
        tmp_path / "registry", blobs_url=f"s3://{bucket[1]}/isplat", blob_options=s3, check_program=ALWAYS_READY
    ) as opened:
        yield opened


def objects(bucket):
    files, name = bucket
    files.invalidate_cache()
    return [path.rsplit("/", 1)[-1] for path in files.find(name)]


def test_s3_objects_are_named_by_digest(registry, bucket, files, tmp_path):
    assert registry.recover().removed == ()
    version = add_ready(registry, files)
    registry.activate("liver", version, None, "admin")
    (key,) = objects(bucket)
    assert key.startswith(f"{sha256(packed_model(files))}-") and key.endswith(".isplat")
    assert not list((tmp_path / "registry" / "incoming").iterdir())
    assert load_bundle(registry.folder_of("liver", version)).sha256() == load_bundle(files / "model-0").sha256()
    add_ready(registry, files, 1)
    assert_whole(registry)
    registry.delete("liver", 2, "admin")
    assert objects(bucket) == [key]


def test_missing_or_changed_s3_object_raises(registry, bucket, files, tmp_path):
    store, name = bucket
    versions = [registry.upload("liver", packed_model(files, seed), None, "surgeon").version for seed in (0, 1)]
    for key in objects(bucket):
        if key.startswith(sha256(packed_model(files, 0))):
            store.rm(f"{name}/isplat/{key}")
        else:
            store.pipe(f"{name}/isplat/{key}", packed_model(files, 1).read_bytes().replace(b"basis", b"basil"))
    with pytest.raises(StoreUnavailable, match="has no"):
        registry.folder_of("liver", versions[0])
    with pytest.raises(BlobDamaged, match="is not what was uploaded"):
        registry.folder_of("liver", versions[1])
    assert [each[:2] for each in registry.recover().damaged] == [("liver", 1)]
    assert not list((tmp_path / "registry" / "incoming").iterdir())


def test_s3_orphan_is_abandoned_only_after_age_limit(bucket, s3):
    store, name = bucket
    orphan = f"{64 * 'a'}-{16 * 'b'}.isplat"
    store.pipe(f"{name}/isplat/{orphan}", b"x")
    young = RemoteBlobs(f"s3://{name}/isplat", s3)
    assert [(blob.key, blob.size, blob.abandoned) for blob in young.stored()] == [(orphan, 1, False)]
    old = RemoteBlobs(f"s3://{name}/isplat", s3, others_upload_s=-60)
    assert [blob.abandoned for blob in old.stored()] == [True]
    old.remove(orphan)
    old.remove(orphan)
    assert old.stored() == []


def test_recover_removes_old_s3_upload_without_row(bucket, s3, files, tmp_path, monkeypatch):
    def stop(step):
        if step == "blob stored":
            raise KeyboardInterrupt

    options = {"blobs_url": f"s3://{bucket[1]}/isplat", "blob_options": s3}
    with ModelRegistry(tmp_path, reached=stop, **options) as registry, pytest.raises(KeyboardInterrupt):
        registry.upload("liver", packed_model(files), None, "surgeon")
    (key,) = objects(bucket)
    with ModelRegistry(tmp_path, **options) as registry:
        assert registry.models() == [] and registry.recover().removed == ()
        monkeypatch.setattr(registry._blobs, "_others_upload_s", -60)
        assert registry.recover().removed == (f"upload {key} that no version names",)
    assert objects(bucket) == []


def test_upload_to_missing_bucket_raises_and_keeps_nothing(s3, credentials, files, tmp_path):
    with ModelRegistry(tmp_path, blobs_url="s3://no-such-bucket/x", blob_options=s3) as registry:
        with pytest.raises(StoreUnavailable, match="no-such-bucket"):
            registry.upload("liver", packed_model(files), None, "surgeon")
        assert registry.models() == [] and not list((tmp_path / "incoming").iterdir())


def test_upload_error_names_unreachable_s3_store(credentials, files, tmp_path):
    options = {"endpoint_url": "http://127.0.0.1:1", "config_kwargs": {"retries": {"max_attempts": 0}}}
    with (
        ModelRegistry(tmp_path, blobs_url="s3://models/x", blob_options=options) as registry,
        pytest.raises(StoreUnavailable, match="s3://models/x"),
    ):
        registry.upload("liver", packed_model(files), None, "surgeon")


def test_registry_raises_for_unknown_blob_protocol(tmp_path):
    with pytest.raises(StoreUnavailable, match="cannot be used: Protocol not known"):
        ModelRegistry(tmp_path, blobs_url="nowhere://models")
