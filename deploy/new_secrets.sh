#!/bin/sh
# Makes what compose.yaml asks for in secrets/: the administrator's key and Grafana's password, at random; what is there stays.
# A container's user has to read them and has no name here: the files are open, and the folder is closed to all but its owner.
# metrics.key holds nothing until the service has made a key for Prometheus (docs/operations.md).
set -eu
cd "$(dirname "$0")"
mkdir -p secrets
chmod 0700 secrets
random() { od -An -N"$1" -tx1 /dev/urandom | tr -d ' \n'; }
[ -s secrets/admin.key ] || printf 'intrasplat_%s_%s\n' "$(random 4)" "$(random 32)" > secrets/admin.key
[ -s secrets/grafana.password ] || printf '%s\n' "$(random 16)" > secrets/grafana.password
[ -e secrets/metrics.key ] || : > secrets/metrics.key
chmod 0644 secrets/admin.key secrets/grafana.password secrets/metrics.key
