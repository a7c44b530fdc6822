//! Scene-wide numbers of patches and vertices, and the instances that they belong to. Pure.
//!
//! A *scene-wide* number counts over all instances, in their order; a *model* number counts within one model. Neither is
//! a place in a client's memory, which has a [`PatchSlot`](shadecast_protocol::ids::PatchSlot) or a
//! [`VertexSlot`](shadecast_protocol::ids::VertexSlot).
//!
//! All LODs have patch numbers: those of the first instance, the finest LOD first, then those of the next
//! instance. LODs share their model's vertices.

/// A patch of an instance, by its scene-wide number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ScenePatch(pub u32);

/// A vertex of an instance, by its scene-wide number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SceneVertex(pub u32);

impl ScenePatch {
    /// As an index into an array by patch.
    pub(crate) fn index(self) -> usize {
        self.0 as usize
    }
}

impl SceneVertex {
    /// As an index into an array by vertex.
    pub(crate) fn index(self) -> usize {
        self.0 as usize
    }

    /// The vertex so many numbers further on.
    pub(crate) fn plus(self, count: u32) -> Self {
        Self(self.0 + count)
    }
}

/// The patches of an instance at one LOD.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PatchRange {
    /// The first.
    pub first: ScenePatch,
    /// How many.
    pub count: u32,
}

impl PatchRange {
    /// The number of one of these patches within its model's LOD.
    pub(crate) fn model_number(self, patch: ScenePatch) -> u32 {
        patch.0 - self.first.0
    }

    /// Whether it is one of these patches.
    pub(crate) fn has(self, patch: ScenePatch) -> bool {
        (self.first.0..self.end()).contains(&patch.0)
    }

    /// The number after the last.
    pub(crate) fn end(self) -> u32 {
        self.first.0 + self.count
    }
}

/// What an instance has, to be numbered.
#[derive(Clone, Debug, Default)]
pub(crate) struct InstanceSize {
    /// Index into the models.
    pub model: usize,
    /// Patches of each LOD, the finest first.
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
    /// Patches of all LODs, over all instances.
    pub patches: u32,
    /// Patches of the two largest LODs of every instance: an LOD set has no more.
    pub in_lod_set: u32,
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
    /// By instance, then by LOD, of which there is one at least.
    patches: Vec<Vec<PatchRange>>,
    /// The same in one list, ascending: the first patch, the instance and the LOD.
    places: Vec<(ScenePatch, u32, u32)>,
}

impl Numbering {
    /// Of a scene with these instances.
    pub(crate) fn new(sizes: &[InstanceSize]) -> Self {
        let mut totals = Totals::default();
        let mut number = |size: &InstanceSize| (totals.place(size), totals.add(size));
        let (instances, patches): (_, Vec<Vec<PatchRange>>) = sizes.iter().map(&mut number).unzip();
        let of_instance = |(instance, lods): (usize, &Vec<PatchRange>)| {
            let place = move |(lod, range): (usize, &PatchRange)| (range.first, instance as u32, lod as u32);
            lods.iter().enumerate().map(place).collect::<Vec<_>>()
        };
        let places = patches.iter().enumerate().flat_map(of_instance).collect();
        Self { instances, totals, patches, places }
    }

    /// The patches of an instance at an LOD; none where its model has no such LOD.
    pub(crate) fn patches(&self, instance: usize, lod: usize) -> Option<PatchRange> {
        self.patches[instance].get(lod).copied().filter(|range| range.count > 0)
    }

    /// The first patch of an instance.
    pub(crate) fn first_patch(&self, instance: usize) -> ScenePatch {
        self.patches[instance][0].first
    }

    /// The instance that a patch of any LOD belongs to, and the LOD.
    pub(crate) fn place_of_patch(&self, patch: ScenePatch) -> (usize, usize) {
        // What has no patches begins where the next begins: the last of them is the one.
        let (_, instance, lod) = self.places[self.places.partition_point(|(first, ..)| *first <= patch) - 1];
        (instance as usize, lod as usize)
    }

    /// The instance that a patch of any LOD belongs to.
    pub fn instance_of_patch(&self, patch: ScenePatch) -> usize {
        self.place_of_patch(patch).0
    }

    /// The instance that a vertex belongs to.
    pub fn instance_of_vertex(&self, vertex: SceneVertex) -> usize {
        self.instances.partition_point(|place| place.first_vertex <= vertex) - 1
    }
}

impl Totals {
    /// The place of an instance after those that are counted.
    fn place(&self, size: &InstanceSize) -> InstancePlace {
        InstancePlace {
            model: size.model,
            first_vertex: SceneVertex(self.vertices),
            is_animated: size.is_animated,
            saved_base: if size.is_animated { self.animated_vertices } else { self.static_vertices },
        }
    }

    /// Counts an instance; gives the numbers of its patches, by LOD.
    fn add(&mut self, size: &InstanceSize) -> Vec<PatchRange> {
        let mut number = |count: &u32| {
            let first = ScenePatch(self.patches);
            self.patches += count;
            PatchRange { first, count: *count }
        };
        let finest = number(size.patches.first().unwrap_or(&0));
        let lods = std::iter::once(finest).chain(size.patches.iter().skip(1).map(&mut number)).collect();
        let mut counts = size.patches.clone();
        counts.sort_unstable_by_key(|count| std::cmp::Reverse(*count));
        self.in_lod_set += counts.iter().take(2).sum::<u32>();
        self.vertices += size.vertices;
        let saved = if size.is_animated { &mut self.animated_vertices } else { &mut self.static_vertices };
        *saved += size.vertices;
        self.palette += size.palette;
        self.bones += size.bones;
        self.morphs += size.morphs;
        lods
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size(patches: &[u32], vertices: u32, is_animated: bool) -> InstanceSize {
        InstanceSize { patches: patches.to_vec(), vertices, is_animated, bones: 3, ..InstanceSize::default() }
    }

    /// A dragon, something without triangles, a rock of one LOD, another dragon.
    fn scene() -> Numbering {
        let dragon = size(&[50, 20, 10], 40, true);
        Numbering::new(&[dragon.clone(), size(&[0], 0, false), size(&[7], 9, false), dragon])
    }

    #[test]
    fn every_patch_of_every_lod_belongs_to_one_instance() {
        let scene = scene();
        let mut owners = vec![None; 2 * 80 + 7];
        for (instance, lod) in (0..4).flat_map(|instance| (0..3).map(move |lod| (instance, lod))) {
            let Some(range) = scene.patches(instance, lod) else { continue };
            for patch in (range.first.0..range.end()).map(ScenePatch) {
                assert_eq!(owners[patch.index()].replace(instance), None, "{patch:?} is numbered once");
                assert_eq!(scene.place_of_patch(patch), (instance, lod), "{patch:?}");
                assert!(range.model_number(patch) < range.count);
            }
        }
        assert!(owners.iter().all(Option::is_some), "no number is left out");
    }

    #[test]
    fn lods_follow_each_other_instance_after_instance() {
        let scene = scene();
        assert_eq!((scene.totals.patches, scene.totals.in_lod_set), (167, 147));
        let first = |instance, lod| scene.patches(instance, lod).map(|range| range.first.0);
        assert_eq!([first(0, 0), first(0, 1), first(0, 2)], [Some(0), Some(50), Some(70)]);
        assert_eq!([first(2, 0), first(3, 0), first(3, 2)], [Some(80), Some(87), Some(157)]);
        assert_eq!([first(1, 0), first(2, 1)], [None, None], "nothing, and no coarser LOD");
        assert_eq!([0, 2, 3].map(|instance| scene.first_patch(instance).0), [0, 80, 87]);
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
