"""The chart, rendered by Helm's own library, against the schemas of Kubernetes and what the registry declares."""

import pytest

from prior_sg.deploy.cli.main import build_parser
from prior_sg.deploy.inspecting.compose import ON_ROBOT
from prior_sg.deploy.running.serve import add_arguments
from prior_sg.services.registry import SERVICES
from tests.help.paths import ROOT

helm = pytest.importorskip("helm_python", reason="`pip install -e '.[manifests]'` brings Helm's library")
validate = pytest.importorskip("kubernetes_validate", reason="`pip install -e '.[manifests]'` brings the schemas")
yaml = pytest.importorskip("yaml")
CHART = ROOT / "deploy/helm/prior-sg"
KUBERNETES = "1.31"
USER = 10001
WITHOUT_SCHEMA = ("ScaledObject",)  # a definition of KEDA's
VALUES = {
    "default": {},
    "keda": {"workers": {"scaling": {"kind": "keda"}}},
    "fixed": {"workers": {"scaling": {"kind": "none"}}, "metrics": {"enabled": False}},
    "all": {
        "robots": ["robot1", "Robot_2"],
        "image": {"tag": "cuda", "pullSecrets": [{"name": "registry"}]},
        "workers": {
            "gpu": 1,
            "space": "onnx:/opt/weights/vit",
            "settings": ["feature_pyramid.batch_size=8"],
            "tolerations": [{"key": "gpu", "operator": "Exists"}],
            "nodeSelector": {"gpu": "yes"},
            "weights": {"existingClaim": "weights"},
        },
        "store": {"storageClass": "fast"},
        "router": {"options": ["--join", "tls/other:7448"], "service": {"loadBalancerSourceRanges": ["10.0.0.0/8"]}},
        "networkPolicy": {"robots": ["10.1.0.0/16"]},
    },
}  # fmt: skip


def rendered(values, name="edge"):
    with helm.Chart.load(CHART) as chart:
        texts = chart.render(values=values, name=name, namespace="robots")
    documents = (one for path, text in texts.items() if path.endswith(".yaml") for one in yaml.safe_load_all(text))
    return [one for one in documents if one]


def pods(manifests):
    """Component to the template of its pods."""
    templates = [one["spec"]["template"] for one in manifests if one["kind"] in ("Deployment", "StatefulSet")]
    return {one["metadata"]["labels"]["app.kubernetes.io/component"]: one for one in templates}


def one_of(manifests, kind, name):
    (found,) = [one for one in manifests if (one["kind"], one["metadata"]["name"]) == (kind, name)]
    return found


def test_helm_finds_no_fault():
    told = helm.lint(CHART, strict=True)
    assert told["errors"] == []
    assert [one["error"] for one in told["messages"]] == ["icon is recommended"]


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES)
def test_what_is_rendered_is_what_kubernetes_takes(values):
    for one in rendered(values):
        if one["kind"] not in WITHOUT_SCHEMA:
            validate.validate(one, KUBERNETES, strict=True)
    names = [(one["kind"], one["metadata"]["name"]) for one in rendered(values)]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES)
def test_no_pod_may_more_than_it_needs(values):
    for component, template in pods(rendered(values)).items():
        spec = template["spec"]
        assert spec["automountServiceAccountToken"] is False
        assert (spec["securityContext"]["runAsNonRoot"], spec["securityContext"]["runAsUser"]) == (True, USER)
        for container in (*spec["initContainers"], *spec["containers"]):
            security = container["securityContext"]
            assert security["readOnlyRootFilesystem"] and not security["allowPrivilegeEscalation"], component
            assert security["capabilities"] == {"drop": ["ALL"]}
            assert container["resources"]["limits"]["memory"] and container["resources"]["requests"]["cpu"]
            mounted, known = {m["name"] for m in container["volumeMounts"]}, {v["name"] for v in spec["volumes"]}
            assert mounted <= known | {"state"}
        assert all("livenessProbe" in container for container in spec["containers"])


def test_every_service_of_an_edge_has_pods_that_say_how_they_are():
    values = VALUES["all"]
    found = pods(rendered(values))
    started = {}
    for component, template in found.items():
        (container,) = template["spec"]["containers"]
        if container["args"][0] == "serve":
            assert container["livenessProbe"]["exec"]["command"] == ["prior-sg", "health", "--here"], component
            started.setdefault(container["args"][1], []).append(container["args"][2:])
    assert set(started) == {service.name for service in SERVICES} - set(ON_ROBOT)
    assert started["segmenter"] == [["--robot", "robot1"], ["--robot", "Robot_2"]]
    assert "feature_pyramid.space=onnx:/opt/weights/vit" in started["feature_pyramid"][0]
    import argparse

    parser = argparse.ArgumentParser()
    add_arguments(parser)
    for service, several in started.items():
        for words in several:
            assert parser.parse_args([service, *words]).service == service


def test_workers_grow_with_how_long_keyframes_wait_and_drain():
    manifests = rendered(VALUES["all"])
    worker = pods(manifests)["feature-pyramid"]["spec"]
    assert worker["terminationGracePeriodSeconds"] == 60
    assert worker["containers"][0]["resources"]["limits"] == {"memory": "6Gi", "nvidia.com/gpu": 1}
    scaler = one_of(manifests, "HorizontalPodAutoscaler", "edge-feature-pyramid")["spec"]
    assert scaler["scaleTargetRef"]["name"] == "edge-feature-pyramid"
    (metric,) = scaler["metrics"]
    assert metric["external"]["target"] == {"type": "Value", "value": "2"}
    assert "replicas" not in one_of(manifests, "Deployment", "edge-feature-pyramid")["spec"], "the scaler's to say"
    budget = one_of(manifests, "PodDisruptionBudget", "edge-feature-pyramid")["spec"]
    assert budget["selector"]["matchLabels"].items() <= pods(manifests)["feature-pyramid"]["metadata"]["labels"].items()
    keda = one_of(rendered(VALUES["keda"]), "ScaledObject", "edge-feature-pyramid")["spec"]
    assert keda["triggers"][0]["metadata"]["query"] == f"max({metric['external']['metric']['name']})"
    assert one_of(rendered(VALUES["fixed"]), "Deployment", "edge-feature-pyramid")["spec"]["replicas"] == 1


@pytest.mark.parametrize(
    "values",
    [{"workers": {"scaling": {"kind": "often"}}}, {"robots": []}, {"robots": ["a/b"]}, {"router": {"port": 70000}}],
)
def test_values_that_make_no_sense_are_refused(values):
    with helm.Chart.load(CHART) as chart, pytest.raises(helm.HelmError):
        chart.validate_schema(values)


def test_the_figures_are_served_with_a_token_by_a_command_that_exists():
    (container,) = pods(rendered({"metrics": {"options": ["--trace", "http://collector:4318"]}}))["metrics"]["spec"][
        "containers"
    ]
    arguments = build_parser().parse_args(container["args"])
    assert (arguments.port, arguments.host, arguments.trace) == (9464, "0.0.0.0", "http://collector:4318")
    assert any(str(arguments.token_file).startswith(one["mountPath"]) for one in container["volumeMounts"])
