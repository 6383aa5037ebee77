#!/bin/sh
# Create the secrets of compose.yaml in secrets/: a random administrator's key and Grafana password. Existing files are kept.
# The container's user has no name on the host, so the files are readable and the folder is accessible to its owner only.
# metrics.key stays empty until the service has created a key for Prometheus (docs/operations.md).
set -eu
cd "$(dirname "$0")"
mkdir -p secrets
chmod 0700 secrets
random() { od -An -N"$1" -tx1 /dev/urandom | tr -d ' \n'; }
[ -s secrets/admin.key ] || printf 'intrasplat_%s_%s\n' "$(random 4)" "$(random 32)" > secrets/admin.key
[ -s secrets/grafana.password ] || printf '%s\n' "$(random 16)" > secrets/grafana.password
[ -e secrets/metrics.key ] || : > secrets/metrics.key
chmod 0644 secrets/admin.key secrets/grafana.password secrets/metrics.key
