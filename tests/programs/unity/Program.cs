// Poses a skeleton as a text file says and writes what the component sets: drive.exe CORRECTIVES.json GIVEN.txt FOUND.txt
using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using Habitus;
using UnityEngine;

static class Program
{
    static string[] words;
    static int at;

    static string Word() { return words[at++]; }
    static float Number() { return float.Parse(Word(), CultureInfo.InvariantCulture); }
    static int Count() { return int.Parse(Word(), CultureInfo.InvariantCulture); }
    static Quaternion Turn() { return new Quaternion(Number(), Number(), Number(), Number()); }

    static int Main(string[] args)
    {
        words = File.ReadAllText(args[1]).Split(new[] { ' ', '\n' }, StringSplitOptions.RemoveEmptyEntries);
        var scene = new Transform { name = "scene", localRotation = Turn() };
        var mesh = new Mesh { name = "body", fullWeight = Number(), bindposes = new Matrix4x4[Count()] };
        var bones = new Transform[mesh.bindposes.Length];
        for (int k = 0; k < bones.Length; k++)
        {
            bones[k] = new Transform { name = Word() };
            int parent = Count();
            bones[k].parent = parent < 0 ? scene : bones[parent];
            mesh.bindposes[k] = new Matrix4x4
            {
                m00 = Number(), m01 = Number(), m02 = Number(), m03 = Number(), m10 = Number(), m11 = Number(),
                m12 = Number(), m13 = Number(), m20 = Number(), m21 = Number(), m22 = Number(), m23 = Number(),
            };
        }
        mesh.shapeNames = new string[Count()];
        for (int k = 0; k < mesh.shapeNames.Length; k++) mesh.shapeNames[k] = Word();
        var skin = new SkinnedMeshRenderer { name = "body", sharedMesh = mesh, bones = bones, weights = new float[mesh.shapeNames.Length] };
        var data = new TextAsset { name = Path.GetFileName(args[0]), text = File.ReadAllText(args[0]) };
        var driver = new PoseCorrectives { name = "person", data = data };
        driver.beside[typeof(SkinnedMeshRenderer)] = skin;
        using (var found = new StreamWriter(args[2]))
            for (int frames = Count(); frames > 0; frames--)
            {
                foreach (var bone in bones) bone.localRotation = Turn();
                driver.Apply();
                if (driver.Problem != null) return 3;
                found.WriteLine(string.Join(" ", Array.ConvertAll(skin.weights, w => w.ToString("R", CultureInfo.InvariantCulture))));
            }
        return 0;
    }
}
