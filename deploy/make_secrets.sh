#!/bin/sh
# Draw every secret that the deployments read from a file, into deploy/secrets or the folder given; keep what is there.
# The folder is closed to others. The files in it are not, for containers read them as users of their own.
set -eu
folder=${1:-$(dirname "$0")/secrets}
mkdir -p "$folder"
chmod 700 "$folder"
cd "$folder"

drawn() { od -An -v -tx1 -N "$1" /dev/urandom | tr -d ' \n'; }

keep() { # a secret's file: what comes in, if there is none yet
    if [ -s "$1" ]; then
        echo "$1: kept"
    else
        cat >"$1.new"
        chmod 444 "$1.new"
        mv "$1.new" "$1"
        echo "$1: made"
    fi
}

drawn 32 | keep ray_token
drawn 24 | keep postgres_password
drawn 24 | keep grafana_password
# The object store shares two keys with each of its clients: never one of these files without the others.
# MLflow's open everything, for it makes the buckets; those of Ray's processes open the bucket dmil alone.
if ! [ -s store.json ] || ! [ -s store_credentials ] || ! [ -s storage_credentials ]; then
    rm -f store.json store_credentials storage_credentials
    access=$(drawn 10) secret=$(drawn 24) own_access=$(drawn 10) own_secret=$(drawn 24)
    keep store.json <<JSON
{"identities": [{"name": "mlflow", "actions": ["Admin", "Read", "Write", "List", "Tagging"],
  "credentials": [{"accessKey": "$access", "secretKey": "$secret"}]},
 {"name": "dmil", "actions": ["Read:dmil", "Write:dmil", "List:dmil"],
  "credentials": [{"accessKey": "$own_access", "secretKey": "$own_secret"}]}]}
JSON
    keep store_credentials <<INI
[default]
aws_access_key_id = $access
aws_secret_access_key = $secret
INI
    keep storage_credentials <<INI
[default]
aws_access_key_id = $own_access
aws_secret_access_key = $own_secret
INI
else
    echo "store.json, store_credentials, storage_credentials: kept"
fi
