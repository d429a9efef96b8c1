#!/usr/bin/env bash
# Renders the chart with each file of values in picofarm/ci and has the result read by Kubernetes' own schemas; the
# values in picofarm/ci/refused must be refused, for the reason that they say. No cluster is needed.
set -euo pipefail
cd "$(dirname "$0")"

for tool in helm kubernetes-validate; do
  command -v "$tool" >/dev/null || { echo "SKIPPED deploy/kubernetes: no $tool here"; exit 0; }
done
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
fail() { echo "deploy/kubernetes: $*" >&2; cat "$out/said" >&2; exit 1; }

for values in picofarm/ci/*.yaml; do
  helm lint --strict --quiet picofarm --values "$values" >"$out/said" 2>&1 || fail "$values: lint"
  for release in farm picofarm; do
    helm template "$release" picofarm --namespace renders --values "$values" >"$out/manifests.yaml" 2>"$out/said" ||
      fail "$values: template"
    kubernetes-validate --strict "$out/manifests.yaml" >"$out/said" 2>&1 || fail "$values: not valid"
    # What it does not know it only warns of; KEDA's is the one such kind that we use.
    if grep -E '^(WARN|ERROR)' "$out/said" | grep -v 'kind ScaledObject '; then fail "$values: not understood"; fi
    # Secrets are named, never held.
    ! grep -q '^kind: Secret' "$out/manifests.yaml" || fail "$values: the chart makes a Secret"
  done
  helm install farm picofarm --namespace renders --values "$values" --dry-run=client >"$out/said" 2>&1 || fail "$values: notes"
  echo "$values: $(grep -c '^kind:' "$out/manifests.yaml") manifests valid"
done

for values in picofarm/ci/refused/*.yaml; do
  reason=$(sed -n 's/^# says: //p' "$values")
  if helm template farm picofarm --values "$values" >"$out/said" 2>&1; then fail "$values: was not refused"; fi
  grep -qF -- "$reason" "$out/said" || fail "$values: expected \"$reason\" in the error"
done
refused=(picofarm/ci/refused/*.yaml)
echo "picofarm/ci/refused: ${#refused[@]} files of values refused"
