"""A body fitted to points: 3D scans, and depth views with or without colour.

Where to begin: `scans` is the recipe for scans and `settings` holds its constants (`ScanSettings`);
`depth` is the recipe for depth views and `depth_settings` holds its constants (`RgbdSettings`).
"Thesis" is Loper's PhD thesis (University of Tuebingen, 2017), chapters 4 (depth views) and 5
(scans); terms without a source are ours.

    file                                        energy or step
    scan_fitting                                scan energy: points or skin offsets, priors, colours
    free_surface                                free surface of a scan about the fitted model
    scan_colours, skin_colours, skin_grid       texture shared by scans; places along the skin
    scan, scan_start, limb_ends, limbs          cleaning; multi-start search, also by the ends of
                                                limbs; lost limbs and hands
    clothes                                     clothes and hair of a scan: weights, what hangs off
    scan_stage, limb_settings                   settings of a stage and of the searches for limbs
    scan_evidence, scan_result, limb_agreement  evidence; result and verdict of a scan fit; limbs
                                                of a person's scans compared
    depth_energy                                depth energy: all terms and their minimisation;
                                                correspondences of depth and outline (`match`)
    skin_offsets                                its term depth with skin offsets; clothes and hair
    colour_terms, colour_views, appearance      its term colour; first light, albedo, camera shift
    prepared_views, depth_start                 segmentation; multi-start search
    depth, depth_limbs                          the recipe; limbs placed again
    depth_evidence, depth_result                evidence; result and verdict of a depth fit
    correspondences                             closest points, soles on the floor and the priors
                                                that both energies use

A term costs 1/2 sum of weight x residual^2; metres, radians. w is Geman-McClure's weight (1 at no
residual) with the scale of the stage.

Scan energy (`scan_fitting`; thesis sec. 5.4 registers with a model term beside the scan's; the form
of these terms is ours). Numbers are those of `ScanSettings.stages`, `.offset_stages` and
`.last_stages`:

    term    weight                                 settings field          residual
    points  w min(1, 1500/N) / noise^2,            ScanStage.noise,        point to plane, and share
            noise 10, 5 mm                         effective_points        `slide` of point to point
    offset  w / noise^2, noise 10, 4, 2.5, 1.5,    ScanStage.noise;        point to plane of model
            1 mm; prior Q: sd 4 mm (bony 2),       offsets,                with offset; h about h0,
            range 0.19, smoothness 1, at last 2;   ScanStage.smoothness,   which a person's scans
            of several scans at last Q / 0.5^2     own_offsets             share
    shape   1; in a sequence 1/0.5^2               ScanStage.shape,        betas - 0, or those of
                                                   shape_change            the frame before
    pose    1 x precision of the pose prior        ScanStage.pose          pose - mean, no root
    colour  spread of tones, at most 1500 points   colours                 place along the skin

In "offset" all N points count in full, as neither the cap of 1500 nor `slide` applies: what points
have in common the offset explains. On the scalp h0 and the standard deviation of h are the measured
thickness of hair, and points there weigh `HairSettings.weight` in "points" once the pose is known
(`clothes`). In the last stages each point of a scan of few has less noise
(`ScanStage.noise_of`). Free surface (`free_surface`, thesis sec. 5.4): a thin plate,
weights `SurfaceStage.stiffness` (mu) and `SurfaceSettings`.

Depth energy (`depth_energy`; thesis eq. 4.3). Fields are those of `RgbdSettings`:

    term     symbol    source         weight                          settings field
    depth    E_D       eqs. 4.3, 4.5  w 0.02 stride^2 / spread^2;     depth, noise, model_sd;
                                      with skin offsets 0.1           skin_depth
    outline  -         ours           w 0.2 stride^2 / (10 mm)^2      outline, outline_sd
    floor    E_F       eq. 4.6        w 2 / (10 mm)^2, of all soles   floor, floor_sd
    shape    E_S       sec. 4.6.1     1                               shape
    pose     E_P       sec. 4.6.1     2 / 0.2^2, stiff 2 / 0.1^2      pose, pose_sd, stiff_sd
    skin     -         ours           1 per number z of the field     skin, skin_reach, skin_places
    colour   E_C, E_Q  eqs. 4.4, 4.7  w 0.02 factor^2 / 0.02^2,       colour, rim; of `appearance`:
                                      edges 0.02 / 0.05^2             noise, smooth_sd, light_sd

On the scalp "depth" and "outline" weigh a hundredth (`DepthStage.scalp_weight`) until hair is
measured, and with skin offsets where it is thick; "colour" leaves that out (`hair_margin`).
With skin offsets the scale of w is 12 mm, but at least 3 times the median distance of the view's
pixels (`skin_scale`, `skin_scale_ratio`).
spread = hypot(noise z^2 cosine, model_sd) for a pixel at distance z (m) whose ray meets the surface
at that cosine, 0.3 at least; stride and factor are full-size pixels along the side of one that is
used. "floor" acts only in stages that move all unknowns (`DepthStage.moves` "all") and with skin
offsets, in views that show a floor: before, the feet are not yet where they belong. In "colour",
pixels at the rim of the body weigh 3 times as much (`rim`).
"""
