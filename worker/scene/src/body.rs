//! Bodies of glass. The renderer treats the space behind a facet's normal as glass, so the facets
//! of a body must enclose a volume and face away from it.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    sync::Arc,
};

use crate::{Affine, Bsdf, Mesh, Object, Vec3};

/// Volumes below this share of the cube of the bounding box's diagonal are rounding errors: a
/// sheet, not a body.
const NO_VOLUME: f64 = 1e-12;

/// The bodies that the facets of one material enclose.
#[derive(Debug, Clone, Copy)]
struct Bodies {
    /// The index of the material in its mesh.
    material: usize,
    /// Whether the facets face away from the bodies, in the mesh's own frame.
    outwards: bool,
}

/// A connected part of a surface.
#[derive(Debug, Clone, Copy)]
struct Part {
    /// The volume by the divergence theorem; positive if the facets face outwards.
    volume: f64,
    lo: Vec3,
    hi: Vec3,
}

impl Part {
    fn holds(&self, other: &Part) -> bool {
        self.lo.min(other.lo) == self.lo && self.hi.max(other.hi) == self.hi
    }

    fn is_flat(&self) -> bool {
        let diagonal = f64::from((self.hi - self.lo).length());
        self.volume.abs() <= NO_VOLUME * diagonal.powi(3)
    }
}

/// Checks the glass bodies of placed meshes with valid indices. The error is the field and its
/// fault.
pub(crate) fn check(objects: &[Object]) -> Result<(), (String, String)> {
    let mut known: BTreeMap<*const Mesh, Vec<Bodies>> = BTreeMap::new();
    for (i, object) in objects.iter().enumerate() {
        let mesh = &object.mesh;
        let at = |material: usize, what: String| {
            let name = &mesh.materials[material].name;
            let field = format!("objects[{i}] ({}).materials[{name}]", object.name);
            (field, format!("dielectric: {what}"))
        };
        let bodies = match known.entry(Arc::as_ptr(mesh)) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(of_mesh(mesh).map_err(|(m, what)| at(m, what))?),
        };
        for body in bodies {
            placed(*body, &object.to_world).map_err(|what| at(body.material, what))?;
        }
    }
    Ok(())
}

/// Like [`check`], for a mesh in its own frame.
pub(crate) fn check_mesh(mesh: &Mesh) -> Result<(), String> {
    of_mesh(mesh)
        .map_err(|(_, what)| what)?
        .into_iter()
        .try_for_each(|body| placed(body, &Affine::IDENTITY))
}

/// Checks in which direction the normals of bodies face in the world.
fn placed(body: Bodies, to_world: &Affine) -> Result<(), String> {
    let [x, y, z] = to_world.linear.map(|r| [r.x, r.y, r.z].map(f64::from));
    let minor = |a: usize, b: usize| y[a] * z[b] - y[b] * z[a];
    let volume = x[0] * minor(1, 2) - x[1] * minor(0, 2) + x[2] * minor(0, 1);
    if volume == 0.0 {
        return Err("to_world makes the body flat; scale it by more than 0".into());
    }
    let mirrored = match volume < 0.0 {
        true => " (to_world mirrors the mesh)",
        false => "",
    };
    match body.outwards == (volume > 0.0) {
        true => Ok(()),
        false => Err(format!(
            "facets face the inside of the body{mirrored}, expected the outside; swap two corners of each (in Mitsuba set \
             flip_normals). A cavity belongs into the mesh of the body around it"
        )),
    }
}

/// Makes thin glass of bodies whose surface has a rim, which therefore enclose no volume. Returns
/// the names of their objects.
pub(crate) fn thin_open_bodies(objects: &mut [Object]) -> Vec<String> {
    let mut known: BTreeMap<*const Mesh, Option<Arc<Mesh>>> = BTreeMap::new();
    let mut names = Vec::new();
    for object in objects {
        let before = Arc::clone(&object.mesh);
        let thinned = known
            .entry(Arc::as_ptr(&before))
            .or_insert_with(|| thinned(&before));
        if let Some(mesh) = thinned {
            object.mesh = Arc::clone(mesh);
            names.push(object.name.clone());
        }
    }
    names
}

/// Returns the mesh with thin glass for its open bodies, or `None` if it has none.
fn thinned(mesh: &Mesh) -> Option<Arc<Mesh>> {
    let corners = mesh.positions.len();
    if mesh
        .triangles
        .iter()
        .flatten()
        .any(|v| *v as usize >= corners)
    {
        // The scene's check reports it.
        return None;
    }
    let mut changed = None;
    for (k, material) in mesh.materials.iter().enumerate() {
        let Bsdf::Dielectric { ior, transmittance } = material.bsdf else {
            continue;
        };
        if has_rim(mesh, k as u32) {
            let mesh = changed.get_or_insert_with(|| mesh.clone());
            mesh.materials[k].bsdf = Bsdf::ThinDielectric {
                ior,
                transmittance,
                face: false,
            };
        }
    }
    changed.map(Arc::new)
}

fn has_rim(mesh: &Mesh, material: u32) -> bool {
    let surface = Surface::of_material(mesh, material);
    let edges = surface.edges();
    edges
        .chunk_by(|a, b| (a.0, a.1) == (b.0, b.1))
        .any(|edge| edge.len() == 1)
}

/// Returns the glass bodies of a mesh. The error is the index of the material and the fault in its
/// facets.
fn of_mesh(mesh: &Mesh) -> Result<Vec<Bodies>, (usize, String)> {
    let glass = mesh.materials.iter().enumerate();
    glass
        .filter(|(_, m)| matches!(m.bsdf, Bsdf::Dielectric { .. }))
        .filter_map(|(k, _)| {
            let outwards = bodies(mesh, k as u32).transpose()?;
            Some(match outwards {
                Ok(outwards) => Ok(Bodies {
                    material: k,
                    outwards,
                }),
                Err(what) => Err((k, what)),
            })
        })
        .collect()
}

/// Returns whether the facets of a material face away from the enclosed volume, or `None` without
/// facets. Facets of cavities face the other way.
fn bodies(mesh: &Mesh, material: u32) -> Result<Option<bool>, String> {
    let surface = Surface::of_material(mesh, material);
    surface.check_edges()?;
    let parts = surface.parts();
    let larger = |a: &&Part, b: &&Part| a.volume.abs().total_cmp(&b.volume.abs());
    let Some(largest) = parts.iter().max_by(larger) else {
        return Ok(None);
    };
    if let Some(flat) = parts.iter().find(|p| p.is_flat()) {
        return Err(format!(
            "the facets from {} to {} enclose no volume; use thin_dielectric for panes and sheets",
            point(flat.lo),
            point(flat.hi)
        ));
    }
    let outwards = largest.volume > 0.0;
    let (mut outer, cavities): (Vec<Part>, Vec<Part>) =
        parts.iter().partition(|p| (p.volume > 0.0) == outwards);
    outer.sort_by(|a, b| b.volume.abs().total_cmp(&a.volume.abs()));
    for cavity in &cavities {
        let size = cavity.volume.abs();
        let mut around = outer.iter().take_while(|o| o.volume.abs() > size);
        if !around.any(|o| o.holds(cavity)) {
            return Err(format!(
                "the closed surface from {} to {} faces the other way than the rest and is no cavity in it; swap two corners of \
                 each of its facets",
                point(cavity.lo),
                point(cavity.hi)
            ));
        }
    }
    Ok(Some(outwards))
}

fn point(p: Vec3) -> String {
    format!("[{}, {}, {}]", p.x, p.y, p.z)
}

/// Facets over positions: vertices at one position count as one.
struct Surface {
    places: Vec<Vec3>,
    facets: Vec<[u32; 3]>,
}

impl Surface {
    fn of_material(mesh: &Mesh, material: u32) -> Self {
        let facets = mesh.triangles.iter().zip(&mesh.triangle_material);
        let facets: Vec<[u32; 3]> = facets.filter(|f| *f.1 == material).map(|f| *f.0).collect();
        Self::new(mesh, &facets)
    }

    fn new(mesh: &Mesh, facets: &[[u32; 3]]) -> Self {
        // −0 equals 0.
        let key =
            |v: u32| <[f32; 3]>::from(mesh.positions[v as usize]).map(|x| (x + 0.0).to_bits());
        let mut keys: Vec<[u32; 3]> = facets.iter().flatten().map(|v| key(*v)).collect();
        keys.sort_unstable();
        keys.dedup();
        let place = |v: u32| {
            let found = keys.binary_search(&key(v));
            found.expect("every corner's place is listed") as u32
        };
        Self {
            facets: facets.iter().map(|t| t.map(place)).collect(),
            places: keys
                .iter()
                .map(|k| Vec3::from(k.map(f32::from_bits)))
                .collect(),
        }
    }

    /// Returns the edges of all facets in order: lower index, higher index, and whether the facet
    /// goes against this order.
    fn edges(&self) -> Vec<(u32, u32, bool)> {
        let mut edges: Vec<(u32, u32, bool)> = self
            .facets
            .iter()
            .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
            // Degenerate facets have edges of equal ends.
            .filter(|(a, b)| a != b)
            .map(|(a, b)| (a.min(b), a.max(b), a > b))
            .collect();
        edges.sort_unstable();
        edges
    }

    /// Checks that along every edge as many facets go one way as the other.
    fn check_edges(&self) -> Result<(), String> {
        let edges = self.edges();
        for edge in edges.chunk_by(|a, b| (a.0, a.1) == (b.0, b.1)) {
            let back = edge.iter().filter(|e| e.2).count();
            if 2 * back == edge.len() {
                continue;
            }
            let at = [edge[0].0, edge[0].1].map(|p| point(self.places[p as usize]));
            let between = format!("along the edge from {} to {}", at[0], at[1]);
            return Err(match edge.len() {
                1 => format!(
                    "the surface has a rim {between}, expected a closed one; close it, or use thin_dielectric (in Mitsuba \
                     thindielectric) for panes and sheets"
                ),
                n if n % 2 == 1 => format!(
                    "{n} facets meet {between}, expected an even number, which bound a body; remove those inside the body"
                ),
                _ => format!(
                    "facets {between} face opposite sides of the surface; swap two corners of those that face the inside of the body"
                ),
            });
        }
        Ok(())
    }

    /// Returns the connected parts.
    fn parts(&self) -> Vec<Part> {
        let mut leader: Vec<u32> = (0..self.places.len() as u32).collect();
        fn find(leader: &mut [u32], mut p: u32) -> u32 {
            while leader[p as usize] != p {
                leader[p as usize] = leader[leader[p as usize] as usize];
                p = leader[p as usize];
            }
            p
        }
        for &[a, b, c] in &self.facets {
            let first = find(&mut leader, a);
            for other in [b, c] {
                let other = find(&mut leader, other);
                leader[other as usize] = first;
            }
        }
        let mut parts: BTreeMap<u32, Part> = BTreeMap::new();
        for &facet in &self.facets {
            let root = find(&mut leader, facet[0]);
            // Any origin is valid; a nearby one preserves precision.
            let origin = self.places[root as usize];
            let part = parts.entry(root).or_insert(Part {
                volume: 0.0,
                lo: origin,
                hi: origin,
            });
            let corners = facet.map(|p| self.places[p as usize]);
            for p in corners {
                (part.lo, part.hi) = (part.lo.min(p), part.hi.max(p));
            }
            part.volume += tetrahedron(origin, corners);
        }
        parts.into_values().collect()
    }
}

/// Returns the signed volume of the tetrahedron from `origin` to a facet.
fn tetrahedron(origin: Vec3, corners: [Vec3; 3]) -> f64 {
    let [a, b, c] = corners
        .map(|p| std::array::from_fn::<f64, 3, _>(|k| f64::from(p[k]) - f64::from(origin[k])));
    let cross = |i: usize, j: usize| b[i] * c[j] - b[j] * c[i];
    (a[0] * cross(1, 2) + a[1] * cross(2, 0) + a[2] * cross(0, 1)) / 6.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Material, shape::Shape};

    fn glass(build: impl FnOnce(&mut Shape, u32)) -> Mesh {
        let mut shape = Shape::new("glass");
        let m = shape.material(Material::solid_glass("glass"));
        build(&mut shape, m);
        shape.finish()
    }

    fn ball(shape: &mut Shape, x: f32, radius: f32, m: u32) {
        shape.ellipsoid(Vec3::new(x, 0.0, 0.0), [radius, radius], 8, m);
    }

    /// Reverses the facets from the k-th on.
    fn turned_from(mut mesh: Mesh, k: usize) -> Mesh {
        for t in &mut mesh.triangles[k..] {
            t.swap(1, 2);
        }
        mesh
    }

    fn refusal(mesh: &Mesh) -> String {
        check_mesh(mesh).expect_err("no body")
    }

    #[test]
    fn closed_surfaces_that_face_outwards_are_bodies() {
        let one = glass(|s, m| ball(s, 0.0, 1.0, m));
        check_mesh(&one).expect("a ball");
        let n = one.triangles.len();
        let two = glass(|s, m| [0.0, 3.0].iter().for_each(|x| ball(s, *x, 1.0, m)));
        check_mesh(&two).expect("two balls");
        let hollow = glass(|s, m| [1.0, 0.5].iter().for_each(|r| ball(s, 0.0, *r, m)));
        check_mesh(&turned_from(hollow, n)).expect("a hollow ball");
        let far = glass(|s, m| s.cuboid([1e4, 0.0, 0.0], [1e4 + 0.01, 2.0, 1.0], m));
        check_mesh(&far).expect("a pane far away");
        // A degenerate facet is ignored.
        let mut mesh = one;
        mesh.triangles.push([3, 3, 4]);
        mesh.triangle_material.push(0);
        check_mesh(&mesh).expect("a ball");
    }

    #[test]
    fn what_bounds_no_body_is_refused_with_the_place() {
        let cube = || glass(|s, m| s.cuboid([0.0; 3], [1.0; 3], m));
        let mut open = cube();
        open.triangles.pop();
        open.triangle_material.pop();
        assert!(refusal(&open).contains("has a rim along the edge from [0, "));
        assert!(refusal(&turned_from(cube(), 11)).contains("face opposite sides"));
        assert!(refusal(&turned_from(cube(), 0)).contains("face the inside of the body,"));
        let mut walled = cube();
        walled.triangles.push([0, 4, 6]);
        walled.triangle_material.push(0);
        assert!(refusal(&walled).contains("3 facets meet along the edge"));
        let sheet = glass(|s, m| {
            let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0f32]];
            let mut corners = corners.map(|[x, y]| Vec3::new(x, y, 0.0));
            s.quad(corners, m);
            corners.reverse();
            s.quad(corners, m);
        });
        assert!(refusal(&sheet).contains("enclose no volume; use thin_dielectric"));
    }

    #[test]
    fn a_body_beside_others_may_not_face_inwards() {
        let n = glass(|s, m| ball(s, 0.0, 0.5, m)).triangles.len();
        let two = glass(|s, m| {
            ball(s, 3.0, 1.0, m);
            ball(s, 0.0, 0.5, m);
        });
        let what = refusal(&turned_from(two, n));
        assert!(
            what.contains("from [-0.5, -0.5, ") && what.contains("no cavity"),
            "{what}"
        );
    }

    #[test]
    fn a_mirrored_placement_turns_a_body_inside_out() {
        let mesh = Arc::new(glass(|s, m| ball(s, 0.0, 1.0, m)));
        let inwards = Arc::new(turned_from(Mesh::clone(&mesh), 0));
        let mut mirror = Affine::IDENTITY;
        mirror.linear[1].y = -2.0;
        let mut flat = Affine::IDENTITY;
        flat.linear[2].z = 0.0;
        let placed = |mesh: &Arc<Mesh>, to_world| {
            let object = Object {
                mesh: mesh.clone(),
                to_world,
                label: 0,
                name: "ball".into(),
            };
            check(&[object])
        };
        placed(&mesh, Affine::IDENTITY).expect("a ball");
        placed(&inwards, mirror).expect("a ball");
        let (field, what) = placed(&mesh, mirror).expect_err("inside out");
        assert_eq!(field, "objects[0] (ball).materials[glass]");
        assert!(what.contains("to_world mirrors"), "{what}");
        let (_, what) = placed(&mesh, flat).expect_err("flat");
        assert!(what.contains("flat"), "{what}");
    }
}
