#!/bin/bash
# Run the steps of docker/Dockerfile's target `cpu` without a Docker engine, in a root created by debootstrap instead of the base image
# (Debian bookworm with its own Python 3.11). At the end the service and its health check run as user 10001.
# Needs root, debootstrap, a network, 12 GB and 5 minutes (with a package mirror) to half an hour. Usage: docker/check_in_clean_root.sh FOLDER [MIRROR]
# TORCH_INDEX_URL and TORCH_SHA256 have the meaning of the image's build arguments. With an empty TORCH_INDEX_URL, torch comes from the lock.
set -euo pipefail
repository=$(cd "$(dirname "$0")/.." && pwd)
root=${1:?give a folder that is not there yet}
mirror=${2:-http://deb.debian.org/debian}
torch_index=${TORCH_INDEX_URL-$(sed -n 's/^ARG TORCH_INDEX_URL=//p' "$repository/docker/Dockerfile")}
[ ! -e "$root" ] || { echo "$root is there already; give another folder" >&2; exit 2; }

step() { echo "== $*" >&2; }
inside() { chroot "$root" /usr/bin/env -i PATH=/opt/intrasplat/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root PIP_NO_CACHE_DIR=1 "${settings[@]}" "$@"; }
# Settings for access to package registries, if needed.
settings=()
for name in http_proxy https_proxy no_proxy PIP_CERT PIP_DEFAULT_TIMEOUT; do [ -z "${!name:-}" ] || settings+=("$name=${!name}"); done

step "base: debootstrap"
debootstrap --variant=minbase --include=python3,python3-venv,ca-certificates bookworm "$root" "$mirror" > /dev/null
ln -s python3 "$root/usr/bin/python"
cp -L /etc/resolv.conf "$root/etc/resolv.conf"
cp -L /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"
mount --bind /proc "$root/proc" && mount --bind /dev "$root/dev"
trap 'umount "$root/proc" "$root/dev"' EXIT

step "packages: a virtual environment with the locked packages"
cp "$repository/requirements-service.lock" "$root/tmp/requirements.lock"
cp "$repository/docker/install_packages.py" "$root/tmp/install_packages.py"
inside python -m venv /opt/intrasplat
inside python /tmp/install_packages.py /tmp/requirements.lock --torch-index-url "$torch_index" --torch-sha256 "${TORCH_SHA256:-}"

step "source and wheel-cpu: compiled as the image does, with what .dockerignore lets through"
inside apt-get update -qq
inside apt-get install -qq -y --no-install-recommends g++ > /dev/null
mkdir -p "$root/src"
(cd "$repository" && cp -r CMakeLists.txt pyproject.toml README.md LICENSE cmake "$root/src/" \
  && git ls-files -z gsplat_core operators services | xargs -0 cp --parents -t "$root/src")
inside sh -c "cd /src && pip wheel --quiet --no-build-isolation --no-deps --wheel-dir /wheels ."

step "trimmed and runtime: without build tools, with tini, a user and folders"
inside pip uninstall --quiet --yes cmake ninja scikit-build-core
inside apt-get purge -qq -y --auto-remove g++ > /dev/null
inside apt-get install -qq -y --no-install-recommends tini > /dev/null
inside useradd --system --uid 10001 --user-group --no-create-home --home-dir /var/lib/intrasplat --shell /usr/sbin/nologin intrasplat
inside install -d -m 0700 -o intrasplat -g intrasplat /var/lib/intrasplat /run/intrasplat
cp "$repository/docker/healthcheck.py" "$root/opt/intrasplat/healthcheck.py"

step "cpu: this package, and nothing from a registry"
inside sh -c "pip install --quiet --no-index --no-deps /wheels/*.whl"

step "as user 10001: doctor, the service, its health check, its end"
as_user() { inside setpriv --reuid 10001 --regid 10001 --clear-groups --no-new-privs --bounding-set=-all env HOME=/tmp PYTHONDONTWRITEBYTECODE=1 \
  INTRASPLAT_PATHS__DATA=/var/lib/intrasplat INTRASPLAT_PATHS__RUNTIME=/run/intrasplat/sockets INTRASPLAT_SERVER__PORT=8791 INTRASPLAT_SERVER__PROBE_PORT=8792 "$@"; }
as_user intrasplat doctor
as_user python -c "import psycopg, s3fs, jwt"
as_user tini -- intrasplat serve &
served=$!
for _ in $(seq 60); do
  sleep 1
  if as_user env HEALTHCHECK_URL=http://127.0.0.1:8792/livez python -I /opt/intrasplat/healthcheck.py > /dev/null; then break; fi
done
as_user env HEALTHCHECK_URL=http://127.0.0.1:8792/livez python -I /opt/intrasplat/healthcheck.py
pkill -TERM --parent $served  # tini, which forwards the signal
wait $served
step "done: the service ended with 0"
