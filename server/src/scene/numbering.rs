//! Scene-wide numbers of patches and vertices, and the instances that they belong to. Pure.
//!
//! A *scene-wide* number counts over all instances, in their order; a *model* number counts within one model. Neither is
//! a place in a client's memory, which has a [`PatchSlot`](shadecast_protocol::ids::PatchSlot) or a
//! [`VertexSlot`](shadecast_protocol::ids::VertexSlot).
//!
//! All levels of detail have patch numbers: first the full detail of every instance, then the next level of every
//! instance, and so on. What has an entry a patch needs no more entries than the levels that are drawn. Levels share
//! their model's vertices.

/// The level of detail that is drawn.
pub const DRAWN_LEVEL: usize = 0;

/// A patch of an instance, by its scene-wide number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ScenePatch(pub u32);

/// A vertex of an instance, by its scene-wide number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SceneVertex(pub u32);

impl ScenePatch {
    /// Of an entry in an array by patch.
    pub fn at(index: usize) -> Self {
        Self(index as u32)
    }

    /// As an index into an array by patch.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

impl SceneVertex {
    /// As an index into an array by vertex.
    pub fn index(self) -> usize {
        self.0 as usize
    }

    /// The vertex so many numbers further on.
    pub fn plus(self, count: u32) -> Self {
        Self(self.0 + count)
    }
}

/// The patches of an instance at one level of detail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PatchRange {
    /// The first.
    pub first: ScenePatch,
    /// How many.
    pub count: u32,
}

impl PatchRange {
    /// The number of one of these patches within its model's level.
    pub fn model_number(self, patch: ScenePatch) -> u32 {
        patch.0 - self.first.0
    }

    fn end(self) -> u32 {
        self.first.0 + self.count
    }
}

/// What an instance has, to be numbered.
#[derive(Clone, Debug, Default)]
pub struct InstanceSize {
    /// Index into the models.
    pub model: usize,
    /// Patches of each level of detail, the finest first.
    pub patches: Vec<u32>,
    /// Vertices.
    pub vertices: u32,
    /// Whether any of them moves.
    pub is_animated: bool,
    /// Palette entries.
    pub palette: u32,
    /// Bones.
    pub bones: u32,
    /// Morph targets.
    pub morphs: u32,
}

/// An instance's place among all.
#[derive(Clone, Copy, Debug)]
pub struct InstancePlace {
    /// Index into the models.
    pub model: usize,
    /// The patches that are drawn.
    pub drawn: PatchRange,
    /// Its first vertex.
    pub first_vertex: SceneVertex,
    /// Whether any vertex of it moves.
    pub is_animated: bool,
    /// First vertex among the static or the animated ones, as `is_animated` says.
    pub saved_base: u32,
}

/// Sizes of what grows with the instances.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Patches that are drawn, over all instances.
    pub patches: u32,
    /// Vertices over all instances.
    pub vertices: u32,
    /// Vertices of instances that do not move.
    pub static_vertices: u32,
    /// Vertices of instances that move.
    pub animated_vertices: u32,
    /// Palette entries over all instances.
    pub palette: u32,
    /// Bones over all instances.
    pub bones: u32,
    /// Morph targets over all instances.
    pub morphs: u32,
}

/// The numbers of a scene.
#[derive(Clone, Debug)]
pub struct Numbering {
    /// By instance.
    pub instances: Vec<InstancePlace>,
    /// Sizes.
    pub totals: Totals,
    /// By level of detail, then by instance.
    patches: Vec<Vec<PatchRange>>,
}

impl Numbering {
    /// Of a scene with these instances.
    pub fn new(sizes: &[InstanceSize]) -> Self {
        let patches = number_patches(sizes);
        let mut totals = Totals::default();
        let place = |(size, drawn): (&InstanceSize, PatchRange)| {
            let place = totals.place(size, drawn);
            totals.add(size, drawn);
            place
        };
        let drawn = patches[DRAWN_LEVEL].iter().copied();
        let instances = sizes.iter().zip(drawn).map(place).collect();
        Self { instances, totals, patches }
    }

    /// The patches of an instance at a level of detail; none where its model has no such level.
    pub fn patches(&self, instance: usize, level: usize) -> Option<PatchRange> {
        self.patches.get(level).map(|ranges| ranges[instance]).filter(|range| range.count > 0)
    }

    /// The instance that a patch of any level belongs to.
    pub fn instance_of_patch(&self, patch: ScenePatch) -> usize {
        let is_within = |ranges: &&Vec<PatchRange>| ranges.last().is_some_and(|last| patch.0 < last.end());
        let ranges = self.patches.iter().find(is_within).expect("a patch of this scene");
        ranges.partition_point(|range| range.first <= patch) - 1
    }

    /// The instance that a vertex belongs to.
    pub fn instance_of_vertex(&self, vertex: SceneVertex) -> usize {
        self.instances.partition_point(|place| place.first_vertex <= vertex) - 1
    }
}

/// By level of detail, then by instance.
fn number_patches(sizes: &[InstanceSize]) -> Vec<Vec<PatchRange>> {
    let levels = sizes.iter().map(|size| size.patches.len()).fold(DRAWN_LEVEL + 1, usize::max);
    let mut next = ScenePatch(0);
    let mut number = |count: u32| {
        let first = next;
        next.0 += count;
        PatchRange { first, count }
    };
    let count = |size: &InstanceSize, level: usize| size.patches.get(level).copied().unwrap_or(0);
    (0..levels).map(|level| sizes.iter().map(|size| number(count(size, level))).collect()).collect()
}

impl Totals {
    /// The place of an instance after those that are counted.
    fn place(&self, size: &InstanceSize, drawn: PatchRange) -> InstancePlace {
        InstancePlace {
            model: size.model,
            drawn,
            first_vertex: SceneVertex(self.vertices),
            is_animated: size.is_animated,
            saved_base: if size.is_animated { self.animated_vertices } else { self.static_vertices },
        }
    }

    fn add(&mut self, size: &InstanceSize, drawn: PatchRange) {
        self.patches += drawn.count;
        self.vertices += size.vertices;
        let saved = if size.is_animated { &mut self.animated_vertices } else { &mut self.static_vertices };
        *saved += size.vertices;
        self.palette += size.palette;
        self.bones += size.bones;
        self.morphs += size.morphs;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size(patches: &[u32], vertices: u32, is_animated: bool) -> InstanceSize {
        InstanceSize { patches: patches.to_vec(), vertices, is_animated, bones: 3, ..InstanceSize::default() }
    }

    /// A dragon, something without triangles, a rock of one level, another dragon.
    fn scene() -> Numbering {
        let dragon = size(&[50, 20, 10], 40, true);
        Numbering::new(&[dragon.clone(), size(&[0], 0, false), size(&[7], 9, false), dragon])
    }

    #[test]
    fn every_patch_of_every_level_belongs_to_one_instance() {
        let scene = scene();
        let mut owners = vec![None; 2 * 80 + 7];
        for (instance, level) in (0..4).flat_map(|instance| (0..3).map(move |level| (instance, level))) {
            let Some(range) = scene.patches(instance, level) else { continue };
            for patch in (range.first.0..range.end()).map(ScenePatch) {
                assert_eq!(owners[patch.index()].replace(instance), None, "{patch:?} is numbered once");
                assert_eq!(scene.instance_of_patch(patch), instance, "{patch:?}");
                assert!(range.model_number(patch) < range.count);
            }
        }
        assert!(owners.iter().all(Option::is_some), "no number is left out");
    }

    #[test]
    fn patches_that_are_drawn_have_the_first_numbers_in_the_order_of_the_instances() {
        let scene = scene();
        assert_eq!(scene.totals.patches, 107);
        let drawn: Vec<_> =
            scene.instances.iter().map(|place| (place.drawn.first.0, place.drawn.count)).collect();
        assert_eq!(drawn, [(0, 50), (50, 0), (50, 7), (57, 50)]);
        assert_eq!(scene.patches(3, DRAWN_LEVEL), Some(scene.instances[3].drawn));
        assert_eq!(scene.patches(0, 1), Some(PatchRange { first: ScenePatch(107), count: 20 }));
        assert_eq!(scene.patches(2, 1), None, "the rock has no coarser level");
    }

    #[test]
    fn every_vertex_belongs_to_one_instance() {
        let scene = scene();
        let owners: Vec<_> = (0..89).map(|vertex| scene.instance_of_vertex(SceneVertex(vertex))).collect();
        let expected = [vec![0; 40], vec![2; 9], vec![3; 40]].concat();
        assert_eq!(owners, expected);
    }

    #[test]
    fn what_moves_and_what_stands_still_are_saved_apart() {
        let scene = scene();
        let saved: Vec<_> =
            scene.instances.iter().map(|place| (place.is_animated, place.saved_base)).collect();
        assert_eq!(saved, [(true, 0), (false, 0), (false, 0), (true, 40)]);
        let Totals { vertices, static_vertices, animated_vertices, bones, .. } = scene.totals;
        assert_eq!((vertices, static_vertices, animated_vertices, bones), (89, 9, 80, 12));
    }

    #[test]
    fn a_scene_without_instances_has_nothing() {
        let scene = Numbering::new(&[]);
        assert_eq!(scene.totals, Totals::default());
        assert!(scene.instances.is_empty());
    }
}
