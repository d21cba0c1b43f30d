#!/bin/sh
# Generate the secrets that deployments read from files, in deploy/secrets or the given folder; keep existing ones.
# Other users cannot enter the folder. The files in it are readable, because containers read them as other users.
set -eu
folder=${1:-$(dirname "$0")/secrets}
mkdir -p "$folder"
chmod 700 "$folder"
cd "$folder"

drawn() { od -An -v -tx1 -N "$1" /dev/urandom | tr -d ' \n'; }

keep() { # write stdin to a secret's file unless it exists
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
drawn 32 | keep serve_token
drawn 24 | keep postgres_password
drawn 24 | keep grafana_password
# The object store shares two keys with each of its clients, so these files are only written together.
# MLflow's keys have all rights, because it creates the buckets; those of Ray's processes open the bucket dmil alone.
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
