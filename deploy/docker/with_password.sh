#!/bin/sh
# Run a command with the database's password from a file: libpq reads PGPASSWORD, so no command line contains it.
set -eu
if [ -n "${PGPASSWORD_FILE:-}" ]; then
    PGPASSWORD=$(cat "$PGPASSWORD_FILE")
    export PGPASSWORD
fi
exec "$@"
