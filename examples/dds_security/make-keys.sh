#!/usr/bin/env bash
# Usage: make-keys.sh FOLDER MEMBER. Makes in FOLDER what the member of a secured DDS graph presents, with openssl alone:
# MEMBER.pem, MEMBER.key, MEMBER.p7s (signed from MEMBER.xml of this folder) and, once, the two authorities and
# governance.p7s. Keep the authorities' keys off the robots: anyone who has them can make members and rules.
set -euo pipefail
umask 077
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1"
cd "$1"
member=$2
authority() {
  [ -f "$1.key" ] && return
  openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -noenc -days 3650 -subj "/CN=$1" \
    -keyout "$1.key" -out "$1.pem" 2>/dev/null
}
signed() {
  openssl smime -sign -text -md sha256 -in "$1" -out "$2" -signer permissions_ca.pem -inkey permissions_ca.key
}
authority identity_ca
authority permissions_ca
openssl req -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -noenc -subj "/CN=$member" \
  -keyout "$member.key" -out "$member.csr" 2>/dev/null
openssl x509 -req -in "$member.csr" -CA identity_ca.pem -CAkey identity_ca.key -CAcreateserial -days 365 \
  -out "$member.pem" 2>/dev/null
rm "$member.csr"
signed "$here/governance.xml" governance.p7s
signed "$here/$member.xml" "$member.p7s"
