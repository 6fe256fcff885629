#!/bin/sh
# Make certificates for Zenoh: a new authority (CA), and a certificate that it signs for each name. docs/how-to/secure.md
# says where each file goes.
#
#   sh certificates.sh FOLDER COMMON-NAME[=ADDRESS,ADDRESS…]…
#   sh certificates.sh tls router=DNS:router.lab,IP:192.0.2.10 gateway viewer
#
# FOLDER must not exist. A router needs every name and address with which others connect to it: DNS:… or IP:….
set -eu
[ $# -ge 2 ] || { echo "usage: sh certificates.sh FOLDER COMMON-NAME[=ADDRESS,ADDRESS…]…" >&2; exit 2; }

mkdir -m 700 "$1"
cd "$1"
shift
openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -noenc -days 3650 \
    -subj "/CN=lab CA" -addext basicConstraints=critical,CA:TRUE -addext keyUsage=critical,keyCertSign,cRLSign \
    -keyout ca.key -out ca.crt

for certificate; do
    name=${certificate%%=*}
    case $certificate in *=*) addresses=${certificate#*=} ;; *) addresses=DNS:$name ;; esac
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -noenc -subj "/CN=$name" \
        -addext "subjectAltName=$addresses" -keyout "$name.key" -out "$name.csr"
    openssl x509 -req -in "$name.csr" -CA ca.crt -CAkey ca.key -days 825 -copy_extensions copy -out "$name.crt"
    rm "$name.csr"
done
