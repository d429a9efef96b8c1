//! Meshes in their rest pose: morph targets at their default weights, and skins with the joints at
//! their nodes' positions.

use gltf::{
    Accessor, Semantic,
    accessor::{DataType, Dimensions, Iter},
};

use crate::{
    SceneError, Vec3,
    import::{format_error, mitsuba::Matrix},
};

use super::{Walk, nodes::of_columns};

/// The deformation of a node's mesh.
#[derive(Debug, Default)]
pub(super) struct Deformation {
    /// The weights of the morph targets.
    weights: Vec<f32>,
    /// The world transforms of the joints after their inverse bind matrices; `None` without a skin.
    joints: Option<Vec<Matrix>>,
}

impl Deformation {
    /// Returns whether the mesh is not deformed.
    pub(super) fn is_none(&self) -> bool {
        self.joints.is_none() && self.weights.iter().all(|w| *w == 0.0)
    }

    /// Returns whether the vertices are in world space.
    pub(super) fn is_skinned(&self) -> bool {
        self.joints.is_some()
    }
}

impl Walk<'_> {
    pub(super) fn deformation(
        &mut self,
        node: &gltf::Node<'_>,
        mesh: &gltf::Mesh<'_>,
    ) -> Result<Deformation, SceneError> {
        let weights = node
            .weights()
            .or(mesh.weights())
            .unwrap_or_default()
            .to_vec();
        let joints = match node.skin() {
            None => None,
            Some(skin) => {
                self.note("skins", "in their rest pose");
                Some(self.joints(&skin)?)
            }
        };
        Ok(Deformation { weights, joints })
    }

    fn joints(&self, skin: &gltf::Skin<'_>) -> Result<Vec<Matrix>, SceneError> {
        let at = format!("skins[{}]", skin.index());
        let fail = |what: String| format_error(self.path, format!("{at}: {what}"));
        let count = skin.joints().count();
        let inverse: Vec<Matrix> = match skin.inverse_bind_matrices() {
            None => vec![Matrix::IDENTITY; count],
            Some(accessor) => {
                self.buffers
                    .check(&accessor, Dimensions::Mat4, &[DataType::F32])
                    .map_err(fail)?;
                let read = Iter::<[[f32; 4]; 4]>::new(accessor, |b| self.buffers.get(&b));
                read.into_iter().flatten().map(of_columns).collect()
            }
        };
        if inverse.len() < count {
            return Err(fail(format!(
                "{} inverse bind matrices for {count} joints",
                inverse.len()
            )));
        }
        skin.joints()
            .zip(&inverse)
            .map(|(joint, inverse)| {
                let world = self.worlds.get(joint.index()).copied().flatten();
                let world = world.ok_or_else(|| {
                    fail(format!(
                        "joint nodes[{}] is not in the scene",
                        joint.index()
                    ))
                })?;
                Ok(self.placed(&world).after(inverse))
            })
            .collect()
    }

    /// Deforms the vertices of a primitive.
    pub(super) fn deformed(
        &mut self,
        primitive: &gltf::Primitive<'_>,
        positions: &mut [Vec3],
        deformation: &Deformation,
        at: &str,
    ) -> Result<(), SceneError> {
        let path = self.path;
        let fail = |what: String| format_error(path, format!("{at}: {what}"));
        for (k, target) in primitive.morph_targets().enumerate() {
            let weight = deformation.weights.get(k).copied().unwrap_or(0.0);
            let Some(accessor) = target.positions().filter(|_| weight != 0.0) else {
                continue;
            };
            self.same_count(&accessor, positions.len())
                .and_then(|()| {
                    self.buffers
                        .check(&accessor, Dimensions::Vec3, &[DataType::F32])
                })
                .map_err(|what| fail(format!("targets[{k}]: {what}")))?;
            let shifts = Iter::<[f32; 3]>::new(accessor, |b| self.buffers.get(&b));
            for (p, shift) in positions.iter_mut().zip(shifts.into_iter().flatten()) {
                *p += Vec3::from(shift) * weight;
            }
        }
        if let Some(joints) = &deformation.joints {
            self.skinned(primitive, positions, joints).map_err(fail)?;
        }
        Ok(())
    }

    fn same_count(&self, accessor: &Accessor<'_>, vertices: usize) -> Result<(), String> {
        match accessor.count() == vertices {
            true => Ok(()),
            false => Err(format!(
                "accessors[{}]: {} entries for {vertices} vertices",
                accessor.index(),
                accessor.count()
            )),
        }
    }

    fn skinned(
        &self,
        primitive: &gltf::Primitive<'_>,
        positions: &mut [Vec3],
        joints: &[Matrix],
    ) -> Result<(), String> {
        let reader = primitive.reader(|b| self.buffers.get(&b));
        // For each vertex: its position times weights, and the sum of its weights.
        let mut sums = vec![([0.0f64; 3], 0.0f64); positions.len()];
        for set in 0u32.. {
            let pair = primitive
                .get(&Semantic::Joints(set))
                .zip(primitive.get(&Semantic::Weights(set)));
            let Some((of_joints, of_weights)) = pair else {
                break;
            };
            let whole = [DataType::U8, DataType::U16];
            let shares = [DataType::F32, DataType::U8, DataType::U16];
            self.buffers.check(&of_joints, Dimensions::Vec4, &whole)?;
            self.buffers.check(&of_weights, Dimensions::Vec4, &shares)?;
            self.same_count(&of_joints, positions.len())?;
            self.same_count(&of_weights, positions.len())?;
            let all = reader.read_joints(set).zip(reader.read_weights(set));
            let Some((indices, weights)) = all else { break };
            let rows = indices.into_u16().zip(weights.into_f32());
            for ((sum, p), (indices, weights)) in sums.iter_mut().zip(&*positions).zip(rows) {
                let p = [p.x, p.y, p.z].map(f64::from);
                for (joint, weight) in indices.into_iter().zip(weights) {
                    if weight == 0.0 {
                        continue;
                    }
                    let joint = joints.get(usize::from(joint)).ok_or_else(|| {
                        format!("JOINTS_{set}: {joint} points past {} joints", joints.len())
                    })?;
                    let weight = f64::from(weight);
                    for (s, row) in sum.0.iter_mut().zip(&joint.0) {
                        *s += weight * (row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3]);
                    }
                    sum.1 += weight;
                }
            }
        }
        for (k, (p, (sum, weight))) in positions.iter_mut().zip(sums).enumerate() {
            if weight.partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
                return Err(format!(
                    "vertex {k} of a skinned mesh has no WEIGHTS_0 above 0; export the skin again, or apply it"
                ));
            }
            *p = Vec3::from(sum.map(|s| (s / weight) as f32));
        }
        Ok(())
    }
}
