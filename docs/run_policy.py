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

data.qpos[:], data.qvel[:] = about["start"]["qpos"], about["start"]["qvel"]
mujoco.mj_step1(model, data)  # positions and velocities
for t in range(len(targets) - 1):
    position = np.vstack((data.geom_xpos[points], data.xipos[bodies[-1]]))
    angular, linear = data.cvel[bodies, :3], data.cvel[bodies, 3:]
    linear = linear + np.cross(angular, position - data.subtree_com[model.body_rootid[bodies]])
    velocity, by_step = np.hstack((linear, angular)), about["observation_by_step"][t]
    parts = (data.qpos, position, data.xquat[bodies], data.qvel, velocity, by_step)
    seen = np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)
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
