{{- define "prior-sg.labels" -}}
app.kubernetes.io/name: prior-sg
app.kubernetes.io/instance: {{ .Release.Name }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ .Chart.Name }}-{{ .Chart.Version }}
{{- end }}

{{- /* What selects pods of one component; call with a dict of root and component. */ -}}
{{- define "prior-sg.selector" -}}
app.kubernetes.io/name: prior-sg
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{- define "prior-sg.fullname" -}}
{{- printf "%s-%s" .root.Release.Name .component | trunc 63 | trimSuffix "-" -}}
{{- end }}

{{- define "prior-sg.image" -}}
{{- printf "%s:%s" .Values.image.repository (default .Chart.AppVersion .Values.image.tag) -}}
{{- end }}

{{- define "prior-sg.router" -}}
tls/{{ include "prior-sg.fullname" (dict "root" . "component" "router") }}:{{ .Values.router.port }}
{{- end }}

{{- define "prior-sg.podSecurity" -}}
runAsNonRoot: true
runAsUser: 10001
runAsGroup: 10001
fsGroup: 10001
fsGroupChangePolicy: OnRootMismatch
seccompProfile: { type: RuntimeDefault }
{{- end }}

{{- define "prior-sg.security" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: { drop: [ALL] }
{{- end }}

{{- /* Keys as files that only their owner reads, which a volume of a group (fsGroup) is not. */ -}}
{{- define "prior-sg.keysInit" -}}
- name: keys
  image: {{ include "prior-sg.image" . }}
  imagePullPolicy: {{ .Values.image.pullPolicy }}
  command: [install, -m, "0400", -t, /keys, /secret/ca.pem, /secret/cert.pem, /secret/key.pem, /secret/bundle.json]
  securityContext: {{- include "prior-sg.security" . | nindent 4 }}
  resources: { requests: { cpu: 10m, memory: 16Mi }, limits: { memory: 64Mi } }
  volumeMounts:
    - { name: secret, mountPath: /secret, readOnly: true }
    - { name: keys, mountPath: /keys }
{{- end }}

{{- define "prior-sg.volumes" -}}
- { name: tmp, emptyDir: {} }
- { name: cache, emptyDir: {} }
- { name: keys, emptyDir: { medium: Memory, sizeLimit: 4Mi } }
- { name: secret, secret: { secretName: {{ .Values.keys.secretName }} } }
{{- end }}

{{- define "prior-sg.mounts" -}}
- { name: tmp, mountPath: /tmp }
- { name: cache, mountPath: /var/cache/prior-sg }
- { name: keys, mountPath: /keys, readOnly: true }
{{- end }}

{{- define "prior-sg.env" -}}
- { name: PSG_KEYS, value: /keys }
- { name: PSG_CONNECT, value: {{ include "prior-sg.router" . | quote }} }
{{- end }}

{{- /* A process that is starting compiles code and loads networks; one that is at a long input is not ended for it. */ -}}
{{- define "prior-sg.probes" -}}
startupProbe:
  exec: { command: [prior-sg, health, --here] }
  periodSeconds: 10
  timeoutSeconds: 15
  failureThreshold: 30
livenessProbe:
  exec: { command: [prior-sg, health, --here] }
  periodSeconds: 30
  timeoutSeconds: 15
  failureThreshold: 4
{{- end }}

{{- /* One service as a pod; call with a dict of root, component, service and values (settings, resources), and where they
       are wanted robot, settings, state (a volume), mounts, volumes, grace. */ -}}
{{- define "prior-sg.pod" -}}
metadata:
  labels:
    {{- include "prior-sg.selector" . | nindent 4 }}
    {{- with .robot }}
    prior-sg/robot: {{ . | quote }}
    {{- end }}
spec:
  automountServiceAccountToken: false
  terminationGracePeriodSeconds: {{ default 30 .grace }}
  securityContext: {{- include "prior-sg.podSecurity" .root | nindent 4 }}
  {{- with .root.Values.image.pullSecrets }}
  imagePullSecrets: {{- toYaml . | nindent 4 }}
  {{- end }}
  {{- with .values.nodeSelector }}
  nodeSelector: {{- toYaml . | nindent 4 }}
  {{- end }}
  {{- with .values.tolerations }}
  tolerations: {{- toYaml . | nindent 4 }}
  {{- end }}
  {{- if .spread }}
  topologySpreadConstraints:
    - maxSkew: 1
      topologyKey: kubernetes.io/hostname
      whenUnsatisfiable: ScheduleAnyway
      labelSelector:
        matchLabels: {{- include "prior-sg.selector" . | nindent 10 }}
  {{- end }}
  initContainers: {{- include "prior-sg.keysInit" .root | nindent 4 }}
  containers:
    - name: {{ .component }}
      image: {{ include "prior-sg.image" .root }}
      imagePullPolicy: {{ .root.Values.image.pullPolicy }}
      args:
        - serve
        - {{ .service }}
        {{- with .robot }}
        - --robot
        - {{ . | quote }}
        {{- end }}
        {{- range concat (default list .settings) (default list .values.settings) }}
        - --set
        - {{ . | quote }}
        {{- end }}
      env: {{- include "prior-sg.env" .root | nindent 8 }}
      securityContext: {{- include "prior-sg.security" .root | nindent 8 }}
      {{- include "prior-sg.probes" .root | nindent 6 }}
      resources: {{- toYaml (default .values.resources .resources) | nindent 8 }}
      volumeMounts:
        {{- include "prior-sg.mounts" .root | nindent 8 }}
        - { name: state, mountPath: /var/lib/prior-sg }
        {{- with .mounts }}
        {{- toYaml . | nindent 8 }}
        {{- end }}
  volumes:
    {{- include "prior-sg.volumes" .root | nindent 4 }}
    {{- if not .claimed }}
    - { name: state, emptyDir: {} }
    {{- end }}
    {{- with .volumes }}
    {{- toYaml . | nindent 4 }}
    {{- end }}
{{- end }}

{{- /* A service with a disk of its own, of which there is one; call as prior-sg.pod, with size. */ -}}
{{- define "prior-sg.single" -}}
apiVersion: apps/v1
kind: StatefulSet
metadata:
  name: {{ include "prior-sg.fullname" . }}
  labels: {{- include "prior-sg.labels" .root | nindent 4 }}
spec:
  serviceName: {{ include "prior-sg.fullname" . }}
  replicas: 1
  selector:
    matchLabels: {{- include "prior-sg.selector" . | nindent 6 }}
  template:
    {{- include "prior-sg.pod" (merge (dict "claimed" true) .) | nindent 4 }}
  volumeClaimTemplates:
    - metadata:
        name: state
      spec:
        accessModes: [ReadWriteOnce]
        {{- with .values.storageClass }}
        storageClassName: {{ . }}
        {{- end }}
        resources: { requests: { storage: {{ .values.size }} } }
{{- end }}
