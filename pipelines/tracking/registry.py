"""Trained policies as models in MLflow's registry: one name per study, profile and arm, one version per run."""

import json
import re
import urllib.parse
import urllib.request
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mlflow import MlflowClient
from mlflow.entities import LoggedModel, LoggedModelOutput, LoggedModelStatus
from mlflow.entities.model_registry import ModelVersion
from mlflow.exceptions import MlflowException
from mlflow.models import Model, ModelSignature
from mlflow.types import ColSpec, Schema, TensorSpec
from mlflow.utils.mlflow_tags import MLFLOW_MODEL_VERSIONS

from pipelines.specs.safe_names import PROFILES, slug
from pipelines.specs.study import RunSpec
from pipelines.tracking.policy import FILE, Saved, load, save, sizes
from pipelines.tracking.tracker import Card, StudyCard
from pipelines.workspace.leftovers import remove, scratch
from rhmc.envs import make_env

with warnings.catch_warnings():  # MLflow's own type hints make it warn
    warnings.simplefilter("ignore")
    from mlflow.pyfunc import save_model

CODE = Path(__file__).with_name("mlflow_model.py")
_PROFILE = re.compile(rf"-({'|'.join(PROFILES)})(-|\Z)")  # what ends the study in a model's name
REQUIREMENTS = [f"torch=={torch.__version__.partition('+')[0]}", f"numpy=={np.__version__}"]


def model_name(study: StudyCard, arm: str) -> str:
    """The registered name of an arm: what stands in `models:/<name>/<version>`. No two arms have the same."""
    words = f"{study.study}-{study.profile}-{arm}"
    told = not _PROFILE.search(study.study)  # else it may be read as another study with another arm
    return slug(words) if told else slug(words, of=f"{study.study}/{study.profile}/{arm}")


def register(client: MlflowClient, run: str, experiment: str, study: StudyCard, card: Card, policy: Path) -> None:
    """Offer a run's policy as a model, once however often it is called.

    The alias `seed-<n>` names the newest version of that seed.

    Args:
        client: of the store.
        run: MLflow's id of the run.
        experiment: that of its experiment.
        study: whose run.
        card: the run.
        policy: its file.
    """
    name = model_name(study, card.arm)
    tags = {"study": study.study, "profile": study.profile, "arm": card.arm, "seed": str(card.seed)}
    tags |= {"spec": card.spec_id, "fingerprint": card.fingerprint, "commit": card.commit}
    made = _registered(client, run, name)
    if made is None:
        model = _logged(client, run, experiment, name.replace(".", "_"), tags, policy)
        try:
            client.create_registered_model(name, tags={k: tags[k] for k in ("study", "profile", "arm")})
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        client.create_model_version(name, model.artifact_location, run, tags, model_id=model.model_id)
        made = _registered(client, run, name)  # asked for: an answer may have been lost, and the request sent twice
        assert made is not None
    client.set_registered_model_alias(name, f"seed-{card.seed}", made.version)
    versions = [{"name": name, "version": made.version}]
    outputs = client.get_run(run).outputs  # a version does not say which model it is of
    assert outputs is not None
    (output,) = outputs.model_outputs
    client.set_logged_model_tags(output.model_id, {MLFLOW_MODEL_VERSIONS: json.dumps(versions)})


def _registered(client: MlflowClient, run: str, name: str) -> ModelVersion | None:
    """The run's version, if there is one; a second one, of a request that was sent twice, is removed."""
    found = client.search_model_versions(f"name = '{name}' and run_id = '{run}'")
    ordered = sorted(found, key=lambda one: int(one.version))
    for double in ordered[1:]:
        client.delete_model_version(name, double.version)
    return ordered[0] if ordered else None


def _logged(
    client: MlflowClient, run: str, experiment: str, name: str, tags: dict[str, str], policy: Path
) -> LoggedModel:
    """Keep the model's files in the store, as an output of the run; what a killed launch left whole is taken up."""
    made = None
    for there in client.search_logged_models([experiment], f"source_run_id = '{run}'"):
        if made is None and there.status == LoggedModelStatus.READY:
            made = there
        else:
            if there.status != LoggedModelStatus.READY:
                _remove_files(there.artifact_location)
            client.delete_logged_model(there.model_id)
    saved = load(policy)
    if made is None:
        made = _written(client, run, experiment, name, tags, saved)
    outputs = client.get_run(run).outputs
    if not outputs or not outputs.model_outputs:
        client.log_outputs(run, [LoggedModelOutput(made.model_id, step=saved.spec.trainer.steps)])
    return made


def _remove_files(location: str) -> None:
    """Remove what a killed launch copied of a model, where files are kept in a folder: MLflow leaves them for good."""
    address = urllib.parse.urlsplit(location)
    if address.scheme in ("", "file"):
        folder = Path(urllib.request.url2pathname(address.path))
        remove(folder)
        with suppress(OSError):
            folder.parent.rmdir()


def _written(
    client: MlflowClient, run: str, experiment: str, name: str, tags: dict[str, str], saved: Saved
) -> LoggedModel:
    spec = saved.spec
    made = client.create_logged_model(experiment, name, run, tags, model_type="policy")
    with scratch() as folder:
        local, file = str(Path(folder) / "model"), Path(folder) / FILE
        save(file, saved)
        save_model(
            local,
            python_model=str(CODE),
            artifacts={"policy": str(file)},
            mlflow_model=Model(artifact_path=made.artifact_location, run_id=run, model_id=made.model_id),
            signature=signature(spec),
            input_example=example(spec),
            pip_requirements=REQUIREMENTS,
            metadata=tags,
        )
        client.log_model_artifacts(made.model_id, local)
    return client.finalize_logged_model(made.model_id, "READY")


def signature(spec: RunSpec) -> ModelSignature:
    """The arrays that a policy takes and gives; -1 is the batch."""
    size, real = sizes(spec.env), np.dtype("float32")
    given: list[ColSpec | TensorSpec] = [
        TensorSpec(array.dtype, (-1, *array.shape[1:]), name) for name, array in example(spec).items()
    ]
    shape = (-1, size.agents, size.actions) if size.continuous else (-1, size.agents)
    return ModelSignature(Schema(given), Schema([TensorSpec(real if size.continuous else np.dtype("int64"), shape)]))


def example(spec: RunSpec) -> dict[str, Any]:
    """The observation at the start of one episode, without the parts that have no features."""
    obs = make_env(spec.env, 1, torch.Generator().manual_seed(0)).reset()
    return {name: part.numpy() for name, part in obs._asdict().items() if part.numel()}
