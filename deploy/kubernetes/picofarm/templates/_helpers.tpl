{{/* Name of everything in this release. */}}
{{- define "picofarm.name" -}}
{{- if contains "picofarm" .Release.Name }}{{ .Release.Name | trunc 50 | trimSuffix "-" }}{{ else }}{{ printf "%s-picofarm" .Release.Name | trunc 50 | trimSuffix "-" }}{{ end }}
{{- end }}

{{/* picofarm.labels (list $ "worker"): what selects a component's pods. */}}
{{- define "picofarm.selector" -}}
app.kubernetes.io/name: picofarm
app.kubernetes.io/instance: {{ (index . 0).Release.Name }}
app.kubernetes.io/component: {{ index . 1 }}
{{- end }}

{{- define "picofarm.labels" -}}
{{ include "picofarm.selector" . }}
app.kubernetes.io/version: {{ (index . 0).Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ (index . 0).Release.Service }}
{{- end }}

{{- define "picofarm.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}

{{- define "picofarm.url" -}}
{{ if .Values.access.tlsSecret }}https{{ else }}http{{ end }}://{{ include "picofarm.name" . }}-coordinator.{{ .Release.Namespace }}.svc:7420
{{- end }}

{{/* Of every pod: no rights in the cluster, no rights on the node, nothing to write but /tmp. */}}
{{- define "picofarm.pod" -}}
serviceAccountName: {{ include "picofarm.name" . }}
automountServiceAccountToken: false
enableServiceLinks: false
{{- with .Values.image.pullSecrets }}
imagePullSecrets:
  {{- range . }}
  - name: {{ . }}
  {{- end }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 64420
  runAsGroup: 64420
  fsGroup: 64420
  seccompProfile:
    type: RuntimeDefault
{{- end }}

{{- define "picofarm.container" -}}
image: {{ include "picofarm.image" . | quote }}
imagePullPolicy: {{ .Values.image.pullPolicy }}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities:
    drop: [ALL]
{{- with .Values.s3.secret }}
envFrom:
  - secretRef:
      name: {{ . }}
{{- end }}
{{- end }}

{{- define "picofarm.env" -}}
- name: HOME
  value: /tmp
- name: PICOFARM_LOG
  value: {{ .Values.log | quote }}
{{- range $name, $value := merge (dict) .Values.env .Values.s3.env }}
- name: {{ $name }}
  value: {{ $value | quote }}
{{- end }}
{{- end }}
