#!/bin/sh
# Make the certificates of both sites with one new authority. docs/how-to/two-sites.md says where each file goes.
#
#   sh certificates.sh FOLDER NAME-OF-A NAME-OF-B
#
# FOLDER must not exist. The names are those with which others connect to the routers: DNS:… or IP:…, several with
# commas between them.
set -eu
[ $# -eq 3 ] || { echo "usage: sh certificates.sh FOLDER NAME-OF-A NAME-OF-B" >&2; exit 2; }

mkdir -m 700 "$1"
cd "$1"
openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -noenc -days 3650 \
    -subj "/CN=sites CA" -addext basicConstraints=critical,CA:TRUE -keyout ca.key -out ca.crt 2>/dev/null

certificate() { # COMMON-NAME, and the names and addresses for the certificate
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -noenc -subj "/CN=$1" \
        -addext "subjectAltName=$2" -keyout "$1.key" -out "$1.csr" 2>/dev/null
    openssl x509 -req -in "$1.csr" -CA ca.crt -CAkey ca.key -days 825 -copy_extensions copy -out "$1.crt" 2>/dev/null
    rm "$1.csr"
}
certificate router-a "$2"
certificate router-b "$3"
certificate recorder-b DNS:recorder-b
echo "ca, router-a, router-b and recorder-b are in $1"
