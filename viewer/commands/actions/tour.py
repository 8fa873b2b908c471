"""Commands of the tour, and of the lecture hall."""

from __future__ import annotations

from nerf_core.common.language import marked

from ...model.state import Action, AppState, TourWish
from ..registry import command


def in_tour(state: AppState) -> bool:
    return state.in_tour


@command("tour.begin", marked("How a NeRF works"), "Help", 1, menu="Help")
def begin(state: AppState) -> list[Action]:
    state.tour, state.show_left_off = TourWish("begin"), False
    return []


@command("tour.next", marked("Next step of the tour"), "Help", 2, keys=("PageDown",), menu="Help", enabled=in_tour)
def forward(state: AppState) -> list[Action]:
    state.tour = TourWish("next")
    return []


@command("tour.back", marked("Previous step of the tour"), "Help", 3, keys=("PageUp",), menu="Help", enabled=in_tour)
def back(state: AppState) -> list[Action]:
    state.tour = TourWish("back")
    return []


@command("tour.leave", marked("Leave the tour"), "Help", 4, menu="Help", enabled=in_tour)
def leave(state: AppState) -> list[Action]:
    state.tour = TourWish("leave")
    return []


@command("show.presenter", marked("For a lecture hall"), "Show or hide", 5, keys=("F5",), menu="View",
         checked=lambda s: s.presenter)  # fmt: skip
def presenter(state: AppState) -> list[Action]:
    """Show large type and strong contrast; within a tour only the panels that the step names."""
    state.presenter = not state.presenter
    return []
