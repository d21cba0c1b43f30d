#!/bin/sh
# Give the command the database's password from a file: libpq takes it from PGPASSWORD, and never from a command line.
set -eu
if [ -n "${PGPASSWORD_FILE:-}" ]; then
    PGPASSWORD=$(cat "$PGPASSWORD_FILE")
    export PGPASSWORD
fi
exec "$@"
