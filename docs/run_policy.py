"""Run an exported policy in plain MuJoCo: python run_policy.py hammer-use1.onnx scene."""

import json
import sys

import mujoco
import numpy as np
import onnxruntime

policy = onnxruntime.InferenceSession(sys.argv[1])
about = json.loads(policy.get_modelmeta().custom_metadata_map["pgdm"])
model = mujoco.MjModel.from_binary_path(f"{sys.argv[2]}/scene.mjb")
data, control, episode = mujoco.MjData(model), about["control"], about["episode"]
points = [model.geom(name).id for name in about["points"]]
bodies = [*model.geom_bodyid[points], model.body(about["object"]).id]
targets, held, errors = np.array(episode["target_pos"]), control["compensated_joints"], []


def product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the product of two quaternions, with a scalar part of 0 or more."""
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, first, second)
    return out if out[0] >= 0 else -out


def relative(t: int, position: np.ndarray, velocity: np.ndarray) -> list[np.ndarray]:
    """Return the first entries with obs=relative: the object relative to its targets and hand."""
    hand, item = (data.xmat[body].reshape(3, 3) for body in (bodies[0], bodies[-1]))
    to_hand, to_item = (data.xquat[body] * (1, -1, -1, -1) for body in (bodies[0], bodies[-1]))
    offsets = targets[np.minimum([t, t + 1, t + 5], len(targets) - 1)] - position[-1]
    return [
        *(offsets, np.tanh(offsets[0] / 0.03)),
        2 * product(np.array(episode["target_quat"][t]), to_item)[1:],
        *((position[-1] - position[0]) @ hand, product(to_hand, data.xquat[bodies[-1]])),
        *((velocity[-1, :3] - velocity[0, :3]) @ hand, (position[tips] - position[-1]) @ item),
    ]


parts = {part["name"]: part["of"] for part in about["observation"]}
tips = [about["points"].index(name) for name in parts.get("fingertips_from_object", [])]
data.qpos[:], data.qvel[:] = about["start"]["qpos"], about["start"]["qvel"]
mujoco.mj_step1(model, data)  # positions and velocities
for t in range(len(targets) - 1):
    position = np.vstack((data.geom_xpos[points], data.xipos[bodies[-1]]))
    angular, linear = data.cvel[bodies, :3], data.cvel[bodies, 3:]
    linear = linear + np.cross(angular, position - data.subtree_com[model.body_rootid[bodies]])
    velocity, by_step = np.hstack((linear, angular)), about["observation_by_step"][t]
    first = relative(t, position, velocity) if "offsets_to_targets" in parts else ()
    seen = (*first, data.qpos, position, data.xquat[bodies], data.qvel, velocity, by_step)
    seen = np.concatenate([np.ravel(part) for part in seen]).astype(np.float32)
    data.ctrl[:] = policy.run(["ctrl"], {"observation": seen[None], "step": np.array([t])})[0][0]
    data.qfrc_applied[:held] = data.qfrc_bias[:held]  # gravity, for the whole control step
    mujoco.mj_step(model, data, control["substeps"])
    mujoco.mj_step1(model, data)
    errors.append(np.linalg.norm(data.xipos[bodies[-1]] - targets[t + 1]))
    if errors[-1] >= episode["lost_at_m"]:
        break
# After a loss the object counts as staying where it is.
errors += [*np.linalg.norm(data.xipos[bodies[-1]] - targets[len(errors) + 1 :], axis=1)]
print(f"success {np.mean(np.array(errors) <= episode['success_threshold_m']):.6f}")
