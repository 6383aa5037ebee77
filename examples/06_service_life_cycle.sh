#!/usr/bin/env bash
# Use the service's REST API with curl: models, a stream, pictures, a recording, a replay, keys and the audit log.
#
#     URL=http://127.0.0.1:8000 KEY_FILE=admin.key examples/06_service_life_cycle.sh
#
# The current folder holds one.isplat and two.isplat (made by `intrasplat pack MODEL FILE`) and case.zip, a recording's folder.
# 06_service_life_cycle.py does the same with the Python client.
set -eu

KEY=$(cat "$KEY_FILE")
ask() { curl --silent --show-error --fail-with-body -H "Authorization: Bearer $KEY" "$@"; }
send() { ask -H "Content-Type: application/json" "$@"; }
upload() {
  ask -X PUT --data-binary "@$2" -H "Content-Type: application/octet-stream" \
    -H "Content-Digest: sha-256=:$(openssl dgst -sha256 -binary "$2" | base64):" "$URL/v1/$1"
}
until_state() { until ask "$URL/v1/$1" | grep -q "\"state\":\"$2\""; do sleep 0.5; done; }

upload models/liver/versions one.isplat                                # made by: intrasplat pack MODEL one.isplat
until_state models/liver/versions/1 ready
send "$URL/v1/models/liver/activate" -d '{"version": 1, "expected_current": null}'
upload models/liver/versions two.isplat
until_state models/liver/versions/2 ready
send "$URL/v1/models/liver/activate" -d '{"version": 2, "expected_current": 1}'
ask -X POST "$URL/v1/models/liver/rollback"                            # to version 1

send "$URL/v1/streams" -d '{"name": "playback", "source": "synthetic:?width=64&height=48&frames=4", "show": "model liver", "device": "cpu"}'
until_state streams/playback live
TICKET=$(send "$URL/v1/tickets" -d '{"path": "/v1/streams/playback/mjpeg"}' | sed 's/.*"ticket":"\([^"]*\)".*/\1/')
curl --silent --max-time 60 "$URL/v1/streams/playback/mjpeg?ticket=$TICKET" | head -c 8192 > pictures.mjpeg   # endless; take a part
ask -X POST "$URL/v1/streams/playback/stop"
ask -X DELETE "$URL/v1/streams/playback"
ask -X DELETE "$URL/v1/models/liver/versions/2"                        # the active one cannot be deleted

upload recordings/case-7 case.zip                                      # a recording's folder, or a video
until_state recordings/case-7 ready
REPLAY=$(send "$URL/v1/replays" -d '{"recording": "case-7", "options": {"steps_per_frame": 4}}' | sed 's/.*"id":"\([^"]*\)".*/\1/')
until_state "replays/$REPLAY" done                                     # frames_done / frames is the progress
ask "$URL/v1/replays/$REPLAY/results/report.json" > report.json
ask -X DELETE "$URL/v1/replays/$REPLAY"
ask -X DELETE "$URL/v1/recordings/case-7"

send "$URL/v1/keys" -d '{"name": "prometheus", "role": "viewer"}' > first.json
send "$URL/v1/keys" -d '{"name": "prometheus", "role": "viewer"}' > second.json   # change the caller over, then:
ask -X DELETE "$URL/v1/keys/$(sed 's/.*"id":"\([^"]*\)".*/\1/' first.json)"
ask "$URL/v1/audit?count=50" > audit.json
ask "$URL/metrics" > metrics.txt
