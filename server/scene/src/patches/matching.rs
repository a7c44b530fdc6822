//! Assignment of triangles to patches: the cheapest division of a graph, whose nodes have at most three sides, into single
//! nodes, pairs and strips of three.
//!
//! On a tree one pass up and one down find the cheapest division exactly. A mesh is no tree. But all joined sides of a given
//! division lie on some spanning tree, and the best division on that tree is no worse. So a few rounds take random trees
//! through the previous round's division. Each round covers exchanges along paths of any length, in time proportional to the
//! nodes.

use crate::{Cancel, Cancelled};

/// In place of a side's twin: the mesh ends there, or its rules forbid a patch across.
pub(super) const NO_TWIN: u32 = u32::MAX;

/// Rounds. The first makes a whole division; most of what the others can gain they have gained by then.
const ROUNDS: u32 = 16;

/// Nodes and what their groups cost. Side `s` of node `n` is entry `3 * n + s`.
#[derive(Debug, Default)]
pub(super) struct Graph {
    /// By side the same side as its other node sees it.
    pub(super) twins: Vec<u32>,
    /// By node what it costs alone; finite.
    pub(super) alone: Vec<f32>,
    /// By side what its two nodes cost together.
    pub(super) pairs: Vec<f32>,
    /// By side what its node costs together with those at its other two sides.
    pub(super) strips: Vec<f32>,
}

/// By side whether its two nodes are in one group.
pub(super) type Joined = Vec<bool>;

impl Graph {
    fn nodes(&self) -> usize {
        self.alone.len()
    }

    /// A cheap division.
    ///
    /// # Errors
    /// Somebody asked to end.
    pub(super) fn divide(&self, cancel: &Cancel) -> Result<Joined, Cancelled> {
        let mut joined = vec![false; self.twins.len()];
        let inner = |side: &u32| self.twins[*side as usize] != NO_TWIN && *side < self.twins[*side as usize];
        let mut sides: Vec<u32> = (0..self.twins.len() as u32).filter(inner).collect();
        let mut order = Order(0x9e37_79b9_7f4a_7c15);
        for _ in 0..ROUNDS {
            cancel.check()?;
            order.shuffle(&mut sides);
            Tree::through(self, &joined, &sides).divide(&mut joined);
        }
        Ok(joined)
    }

    /// What a division costs.
    #[cfg(test)]
    pub(super) fn cost(&self, joined: &Joined) -> f64 {
        let of_node = |node: usize| {
            let mine: Vec<usize> = (3 * node..3 * node + 3).filter(|side| joined[*side]).collect();
            let degree = |node: usize| joined[3 * node..3 * node + 3].iter().filter(|is| **is).count();
            match mine[..] {
                [] => f64::from(self.alone[node]),
                // Half of a pair is each node's; the end of a strip is the middle's to count.
                [side] if degree(self.twins[side] as usize / 3) == 1 => f64::from(self.pairs[side]) * 0.5,
                [_] => 0.0,
                [a, b] => f64::from(self.strips[9 * node + 3 - a - b]),
                _ => panic!("a group of more than three"),
            }
        };
        (0..self.nodes()).map(of_node).sum()
    }
}

/// The same numbers on every machine.
struct Order(u64);

impl Order {
    /// Below `bound`.
    fn below(&mut self, bound: usize) -> usize {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (((self.0 >> 32) * bound as u64) >> 32) as usize
    }

    fn shuffle(&mut self, values: &mut [u32]) {
        for last in (1..values.len()).rev() {
            values.swap(last, self.below(last + 1));
        }
    }
}

/// What becomes of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Alone,
    /// With the child at this side.
    Pair(u32),
    /// Middle between its other sides, where all but this one lead to children.
    Middle(u32),
    /// End of a strip, the middle of which is the child at this side.
    End(u32),
}

/// A spanning tree of each connected part of a graph, and the cheapest division along it.
struct Tree<'a> {
    graph: &'a Graph,
    /// By side whether it is in the tree.
    edges: Vec<bool>,
    /// Nodes, parents before their children.
    order: Vec<u32>,
    /// By node its side towards the parent.
    up: Vec<u32>,
    /// By node what its group costs, less what that group spares the nodes under it. All of a node's
    /// costs are taken like that, relative to nodes under it that look after themselves.
    own: Vec<f32>,
    /// By node the same where it is the middle between a child and its parent.
    bridge: Vec<f32>,
    /// By node how it is cheapest.
    part: Vec<Part>,
    /// By node its side that is left out where it is such a middle.
    bridge_side: Vec<u32>,
}

impl<'a> Tree<'a> {
    /// A tree of all joined sides, and of others as they come.
    fn through(graph: &'a Graph, joined: &Joined, sides: &[u32]) -> Self {
        let mut edges = vec![false; graph.twins.len()];
        let mut sets = Sets::new(graph.nodes());
        let (first, rest): (Vec<u32>, Vec<u32>) = sides.iter().partition(|side| joined[**side as usize]);
        for side in first.into_iter().chain(rest) {
            let twin = graph.twins[side as usize];
            if sets.unite(side / 3, twin / 3) {
                (edges[side as usize], edges[twin as usize]) = (true, true);
            }
        }
        let (order, up) = from_roots(graph, &edges);
        let nodes = graph.nodes();
        let (own, bridge) = (vec![0.0; nodes], vec![f32::INFINITY; nodes]);
        let (part, bridge_side) = (vec![Part::Alone; nodes], vec![NO_TWIN; nodes]);
        Self { graph, edges, order, up, own, bridge, part, bridge_side }
    }

    fn divide(mut self, joined: &mut Joined) {
        for place in (0..self.order.len()).rev() {
            self.weigh(self.order[place]);
        }
        joined.fill(false);
        self.join(joined);
    }

    /// The node at a side, where the tree goes on there, away from the root.
    fn child(&self, side: u32) -> Option<usize> {
        let is_down = self.edges[side as usize] && self.up[side as usize / 3] != side;
        is_down.then(|| self.graph.twins[side as usize] as usize / 3)
    }

    /// Finds the cheapest part of a node whose children are done.
    fn weigh(&mut self, node: u32) {
        let mut best = (self.graph.alone[node as usize], Part::Alone);
        let mut offer = |cost: f32, part: Part| {
            if cost < best.0 {
                best = (cost, part);
            }
        };
        let up = self.up[node as usize];
        let mut bridge = (f32::INFINITY, NO_TWIN);
        for side in 3 * node..3 * node + 3 {
            if let Some(child) = self.child(side) {
                offer(self.graph.pairs[side as usize] - self.own[child], Part::Pair(side));
                offer(self.bridge[child] - self.own[child], Part::End(side));
            }
            let [left, right] = others(side);
            let strip = self.graph.strips[side as usize];
            match (self.child(left), self.child(right)) {
                (Some(a), Some(b)) => offer(strip - self.own[a] - self.own[b], Part::Middle(side)),
                (Some(a), None) if right == up => bridge = cheaper(bridge, (strip - self.own[a], side)),
                (None, Some(b)) if left == up => bridge = cheaper(bridge, (strip - self.own[b], side)),
                _ => {}
            }
        }
        let node = node as usize;
        (self.own[node], self.part[node]) = best;
        (self.bridge[node], self.bridge_side[node]) = bridge;
    }

    /// Joins what is cheapest, from the roots on.
    fn join(&self, joined: &mut Joined) {
        let mut is_taken = vec![false; self.graph.nodes()];
        let mut connect = |side: u32| {
            let twin = self.graph.twins[side as usize];
            (joined[side as usize], joined[twin as usize]) = (true, true);
            twin / 3
        };
        for node in &self.order {
            if is_taken[*node as usize] {
                continue;
            }
            match self.part[*node as usize] {
                Part::Alone => {}
                Part::Pair(side) => is_taken[connect(side) as usize] = true,
                Part::Middle(side) => others(side).into_iter().for_each(|side| {
                    is_taken[connect(side) as usize] = true;
                }),
                Part::End(side) => {
                    let middle = connect(side);
                    is_taken[middle as usize] = true;
                    let up = self.up[middle as usize];
                    let down = others(self.bridge_side[middle as usize]).into_iter().find(|side| *side != up);
                    is_taken[connect(down.expect("one of two")) as usize] = true;
                }
            }
        }
    }
}

fn cheaper(a: (f32, u32), b: (f32, u32)) -> (f32, u32) {
    if b.0 < a.0 { b } else { a }
}

/// The other two sides of a side's node, in their order around it.
pub(super) fn others(side: u32) -> [u32; 2] {
    let first = side - side % 3;
    [first + (side + 1) % 3, first + (side + 2) % 3]
}

/// All nodes, those of a tree one after the other and parents first; by node its side towards the parent.
fn from_roots(graph: &Graph, edges: &[bool]) -> (Vec<u32>, Vec<u32>) {
    let mut order: Vec<u32> = Vec::with_capacity(graph.nodes());
    let mut up = vec![NO_TWIN; graph.nodes()];
    let mut is_known = vec![false; graph.nodes()];
    for root in 0..graph.nodes() as u32 {
        if std::mem::replace(&mut is_known[root as usize], true) {
            continue;
        }
        let mut next = order.len();
        order.push(root);
        while let Some(node) = order.get(next).copied() {
            next += 1;
            for side in (3 * node..3 * node + 3).filter(|side| edges[*side as usize]) {
                let twin = graph.twins[side as usize];
                if !std::mem::replace(&mut is_known[twin as usize / 3], true) {
                    up[twin as usize / 3] = twin;
                    order.push(twin / 3);
                }
            }
        }
    }
    (order, up)
}

/// Disjoint sets of nodes.
struct Sets(Vec<u32>);

impl Sets {
    fn new(nodes: usize) -> Self {
        Self((0..nodes as u32).collect())
    }

    fn find(&mut self, mut node: u32) -> u32 {
        while self.0[node as usize] != node {
            let above = self.0[self.0[node as usize] as usize];
            self.0[node as usize] = above;
            node = above;
        }
        node
    }

    /// False where both are in one set already.
    fn unite(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.find(a), self.find(b));
        // The smaller number leads: which one does not matter, and halving keeps the ways short.
        self.0[a.max(b) as usize] = a.min(b);
        a != b
    }
}

#[cfg(test)]
mod tests;
