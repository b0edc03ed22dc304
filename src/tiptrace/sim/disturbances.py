"""What makes a rig differ from what its user believes: four levels, every disturbance with a switch of its own."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

LevelName = Literal["clean", "nominal", "hard", "unseen"]
Sigma = Annotated[float, Field(ge=0)]
Gain = Annotated[float, Field(gt=0, le=1)]
Share = Annotated[float, Field(ge=0, lt=1)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class MarkerNoise(_Model):
    """Injected into 3-D markers in mode ``markers`` only; in ``images`` all of this arises by itself.

    Attributes:
        in_plane_m: White noise of x_S and y_S.
        depth_m: White noise of the depth.
        tilt_rad: Slow tilt of a pad's depth, standard deviation of an Ornstein–Uhlenbeck process.
        tilt_s: Its time constant.
        bias_m: Constant depth error of each marker.
        shown_depth: Share of the depth that the markers show.
    """

    in_plane_m: Sigma = 0.0
    depth_m: Sigma = 0.0
    tilt_rad: Sigma = 0.0
    tilt_s: Annotated[float, Field(gt=0)] = 1.5
    bias_m: Sigma = 0.0
    shown_depth: Gain = 1.0


class Disturbances(_Model):
    """Everything that can be wrong, each switchable by its own value; the defaults are a perfect rig.

    Attributes:
        markers: Noise of 3-D markers (mode ``markers``).
        shown_shear: Share of the gel surface's motion that the dots below it make (both modes).
        nominal_tip_m: σ per axis of the error of the tip that the user believes in.
        T_E_S_rotation_deg: Rotation error of each believed sensor pose, about a random axis.
        T_E_S_translation_m: Its translation error, in a random direction.
        mm_per_px: σ of the believed scale's relative error.
        opening_m: Error of the reported gripper opening.
        latency_s: Image stamp minus exposure.
        latency_known: Whether the rig file states the latency.
        jitter_s: σ of the image stamps' jitter.
        pose_noise_m: White noise of the reported position, per axis.
        pose_noise_deg: And of the orientation.
        pose_bias_m: Constant error of the reported position, in a random direction.
        dropped: Share of image pairs lost.
        repeated: Share of images delivered once more instead of the new one.
        frozen_s: A camera (left) freezes for this long in mid-trial.
        gel_stiffness: True stiffness over the calibrated one.
        gel_stiffening: Growth of the normal stiffness with strain (0: linear springs).
        grasp_drift_deg: Rotation by which the tool creeps against the pads over the trial, unseen by the dots.
        illumination_drift: Relative change of each lamp over the trial, σ (mode ``images``).
        camera_noise: Sensor noise and grain over those of a real GelSight Mini; 0 switches them off.
        optics: ``fitted`` is the gel that the shading was fitted to, ``standard`` another of the same make,
            ``unseen`` one from beyond that range.
        gel_law: How the gel deforms around the contact; ``unseen`` bulges.
    """

    markers: MarkerNoise = MarkerNoise()
    shown_shear: Gain = 1.0
    nominal_tip_m: Sigma = 0.0
    T_E_S_rotation_deg: Sigma = 0.0
    T_E_S_translation_m: Sigma = 0.0
    mm_per_px: Sigma = 0.0
    opening_m: float = 0.0
    latency_s: Annotated[float, Field(ge=0, lt=1)] = 0.0
    latency_known: bool = False
    jitter_s: Sigma = 0.0
    pose_noise_m: Sigma = 0.0
    pose_noise_deg: Sigma = 0.0
    pose_bias_m: Sigma = 0.0
    dropped: Share = 0.0
    repeated: Share = 0.0
    frozen_s: Sigma = 0.0
    gel_stiffness: Annotated[float, Field(gt=0)] = 1.0
    gel_stiffening: Sigma = 0.0
    grasp_drift_deg: float = 0.0
    illumination_drift: Sigma = 0.0
    camera_noise: Sigma = 1.0
    optics: Literal["fitted", "standard", "unseen"] = "fitted"
    gel_law: Literal["standard", "unseen"] = "standard"


LEVELS: dict[LevelName, Disturbances] = {
    "clean": Disturbances(
        markers=MarkerNoise(in_plane_m=0.02e-3, depth_m=0.05e-3),
        latency_known=True,
    ),
    "nominal": Disturbances(
        markers=MarkerNoise(
            in_plane_m=0.03e-3, depth_m=0.10e-3, tilt_rad=0.01, bias_m=0.05e-3, shown_depth=0.85
        ),
        shown_shear=0.95,
        nominal_tip_m=3e-3,
        T_E_S_rotation_deg=1.0,
        T_E_S_translation_m=0.5e-3,
        latency_s=0.040,
        pose_noise_m=0.05e-3,
        pose_noise_deg=0.03,
        illumination_drift=0.002,
        optics="standard",
    ),
    "hard": Disturbances(
        markers=MarkerNoise(
            in_plane_m=0.05e-3, depth_m=0.15e-3, tilt_rad=0.03, bias_m=0.10e-3, shown_depth=0.60
        ),
        shown_shear=0.85,
        nominal_tip_m=8e-3,
        T_E_S_rotation_deg=2.0,
        T_E_S_translation_m=1.0e-3,
        latency_s=0.080,
        pose_noise_m=0.05e-3,
        pose_noise_deg=0.03,
        grasp_drift_deg=3.0,
        illumination_drift=0.004,
        optics="standard",
    ),
    # Beyond the priors of any estimator here: frozen before the estimators were tuned.
    "unseen": Disturbances(
        markers=MarkerNoise(
            in_plane_m=0.06e-3, depth_m=0.20e-3, tilt_rad=0.04, tilt_s=3.0, bias_m=0.12e-3, shown_depth=0.70
        ),
        shown_shear=0.80,
        nominal_tip_m=6e-3,
        T_E_S_rotation_deg=2.5,
        T_E_S_translation_m=1.5e-3,
        mm_per_px=0.01,
        latency_s=0.110,
        jitter_s=0.002,
        pose_noise_m=0.08e-3,
        pose_noise_deg=0.04,
        dropped=0.01,
        gel_stiffness=0.75,
        gel_stiffening=0.8,
        grasp_drift_deg=2.0,
        illumination_drift=0.008,
        optics="unseen",
        gel_law="unseen",
    ),
}
