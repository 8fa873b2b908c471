"""The state of a run as windows see it."""

from __future__ import annotations

from dataclasses import replace

from nerf_core.common.device import describe, memory_held
from nerf_core.live.messages import Snapshot, Status
from nerf_core.live.run import Run
from nerf_core.live.scheduler import Scheduler
from nerf_core.training.pose_records import PoseCorrections
from nerf_core.training.trainer import Trainer


def snapshot_of(run: Run, before: Snapshot, scheduler: Scheduler) -> Snapshot:
    """The state to publish. before: the one that was published last; its picture stays until the scene has another."""
    if before.loaded != run.loaded:
        before = replace(before, preview=None)
    status, trainer, budget = status_of(run), run.trainer, scheduler.budget
    shown = replace(
        before, run=run.number, status=status, loading=run.loading, posing=run.posing, loaded=run.loaded,
        scene=run.scene, corrections=None, wanted_share=scheduler.wanted, share_rule=scheduler.rule,
        frame_share=budget.frame_share(), export=run.exports.newest,
    )  # fmt: skip
    if trainer is None:
        return shown
    ray = run.artist.ray
    rate = scheduler.rays_per_second(run.number) if status == "training" else 0.0
    return replace(
        shown,
        scene=trainer.scene,
        corrections=_corrections(trainer, before),
        method=trainer.method_name,
        coarse=trainer.method.coarse,
        stage=trainer.method.stage,
        method_reason=trainer.reason,
        config=trainer.config.to_json(),
        device=describe(trainer.device),
        step=trainer.step_count,
        saved_step=run.saved_step,
        total_steps=trainer.total_steps,
        seconds=trainer.seconds,
        rays_per_second=rate,
        seconds_left=run.seconds_left(rate),
        train_share=budget.train_share(),
        memory_bytes=memory_held(trainer.device),
        history=trainer.history.view(),
        preview=run.artist.preview(shown.preview),
        opened=ray.opened,
        opened_id=ray.id if ray.opened is not None else 0,
        opened_look=ray.answered,
        opened_step=ray.opened_step,
        pins=tuple(run.artist.pins),
        preview_rays_per_second=run.artist.rays_per_second("fine"),
    )


def _corrections(trainer: Trainer, before: Snapshot) -> PoseCorrections | None:
    """Those of the trainer, or of the snapshot before if nothing changed since."""
    if trainer.scene is before.scene and before.corrections is not None:
        return before.corrections
    return trainer.corrections


def status_of(run: Run) -> Status:
    """What a run is doing, in one word."""
    if run.loading:
        return "loading"
    if run.failed:
        return "failed"
    trainer = run.trainer
    if trainer is None:
        return "empty"
    if run.training:
        return "training"
    if trainer.step_count >= trainer.total_steps:
        return "finished"
    return "paused" if trainer.step_count else "ready"
