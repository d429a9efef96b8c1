//! A room being furnished: the placed objects, and tests for free space.

use std::sync::Arc;

use crate::{
    Affine, AssetLibrary, Mesh, Object,
    assets::Asset,
    label::label_id,
    layout::{Footprint, Room},
    trace::{Model, World},
};

/// The gap between furniture and the floor or its support, so that no two surfaces coincide
/// (metres).
pub(super) const CONTACT_GAP: f32 = 5e-4;

/// An object in the room.
#[derive(Debug, Clone)]
pub(super) struct Placed {
    pub(super) model: Arc<Model>,
    pub(super) label: &'static str,
    pub(super) name: String,
    /// The bottom centre of the model's box.
    pub(super) at: [f32; 3],
    pub(super) yaw: f32,
    /// The box that no other object may enter; `None` for the room itself and for rugs.
    pub(super) foot: Option<Footprint>,
    pub(super) attribution: Option<String>,
    /// The changes made to the model.
    pub(super) changes: Vec<&'static str>,
}

/// A room and the objects placed so far.
#[derive(Debug)]
pub(super) struct Plan<'a> {
    pub(super) room: Room,
    pub(super) assets: &'a AssetLibrary,
    pub(super) placed: Vec<Placed>,
    /// Reserved free space, in front of the door.
    pub(super) reserved: Vec<Footprint>,
    /// The corner that an L-shaped room lacks.
    pub(super) solid: Option<Footprint>,
}

/// Returns half of a model's extents on the plan.
pub(super) fn half_of(model: &Model) -> [f32; 2] {
    let [w, _, d] = model.size();
    [w * 0.5, d * 0.5]
}

impl<'a> Plan<'a> {
    pub(super) fn new(room: Room, assets: &'a AssetLibrary) -> Self {
        Self {
            room,
            assets,
            placed: Vec::new(),
            reserved: Vec::new(),
            solid: None,
        }
    }

    /// Adds a part of the room itself, in world coordinates.
    pub(super) fn fix(&mut self, mesh: Mesh, label: &'static str) {
        let model = Model::new(mesh).expect("parts of the room have triangles");
        self.push(Placed {
            model: Arc::new(model),
            label,
            name: label.to_owned(),
            at: [0.0; 3],
            yaw: 0.0,
            foot: None,
            attribution: None,
            changes: Vec::new(),
        });
    }

    /// Adds `model` if its box is inside the room and free; `support` is the object under it.
    pub(super) fn try_place(
        &mut self,
        (name, model): (&str, &Arc<Model>),
        label: &'static str,
        at: [f32; 3],
        yaw: f32,
        support: Option<usize>,
    ) -> bool {
        let foot = Footprint::new(at, yaw, half_of(model), model.size()[1]);
        if !self.is_free(&foot, support) {
            return false;
        }
        self.push(Placed {
            model: model.clone(),
            label,
            name: name.to_owned(),
            at,
            yaw,
            foot: Some(foot),
            attribution: None,
            changes: Vec::new(),
        });
        true
    }

    /// Like [`Plan::try_place`], for an asset with a creator who must be named.
    pub(super) fn try_place_asset(
        &mut self,
        (asset, model): (&Asset, &Arc<Model>),
        at: [f32; 3],
        yaw: f32,
        support: Option<usize>,
    ) -> bool {
        let placed = self.try_place((&asset.name, model), asset.label, at, yaw, support);
        if let (true, Some(last)) = (placed, self.placed.last_mut()) {
            last.attribution.clone_from(&asset.attribution);
            last.changes = asset.changes().collect();
        }
        placed
    }

    /// Adds a flat object on which furniture may be placed.
    pub(super) fn lay(&mut self, (asset, model): (&Asset, &Arc<Model>), at: [f32; 3], yaw: f32) {
        self.push(Placed {
            model: model.clone(),
            label: asset.label,
            name: asset.name.clone(),
            at,
            yaw,
            foot: None,
            attribution: asset.attribution.clone(),
            changes: asset.changes().collect(),
        });
    }

    fn push(&mut self, placed: Placed) {
        self.placed.push(placed);
    }

    /// Returns whether the box is inside the room and overlaps no object except its support.
    pub(super) fn is_free(&self, foot: &Footprint, support: Option<usize>) -> bool {
        let taken = self.placed.iter().enumerate().any(|(k, p)| {
            Some(k) != support && p.foot.as_ref().is_some_and(|other| other.overlaps(foot))
        });
        let mut closed = self.reserved.iter().chain(&self.solid);
        self.room.holds(foot) && !taken && !closed.any(|r| r.overlaps(foot))
    }

    /// Returns all placed objects, ready for rays; indices are those of `placed`.
    pub(super) fn world(&self) -> World {
        let mut world = World::default();
        for p in &self.placed {
            world.add(p.model.clone(), p.to_world());
        }
        world
    }

    /// Returns all placed objects in the form of a scene.
    pub(super) fn objects(&self) -> Vec<Object> {
        self.placed
            .iter()
            .map(|p| Object {
                mesh: p.model.mesh.clone(),
                to_world: p.to_world(),
                label: label_id(p.label),
                name: p.name.clone(),
            })
            .collect()
    }
}

impl Placed {
    pub(super) fn to_world(&self) -> Affine {
        if self.yaw == 0.0 && self.at == [0.0; 3] {
            return Affine::IDENTITY;
        }
        Affine::yaw_then_move(self.yaw, self.at.into())
    }
}
